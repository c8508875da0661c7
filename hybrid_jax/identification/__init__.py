"""Identify a vehicle from recordings of commands and of whatever was measured.

`measured` cuts windows and estimates their initial states, `fitting` fits the parameters through the ODE solver.
`optimal_design` finds the experiment that tells parameters best, before it is made.
"""

from hybrid_jax.identification.designs import FlightBounds, InputBounds
from hybrid_jax.identification.fitting import Identified, identify, identify_in_turn, prediction_errors
from hybrid_jax.identification.measured import Layout
from hybrid_jax.identification.optimal_design import Excitation, excitation

__all__ = ["Excitation", "FlightBounds", "Identified", "InputBounds", "Layout", "excitation", "identify"]
__all__ += ["identify_in_turn", "prediction_errors"]
