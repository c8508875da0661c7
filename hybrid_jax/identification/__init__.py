"""Identify a vehicle from recordings of commands and of whatever was measured.

`recordings` cuts windows and estimates their initial states, `fitting` fits the parameters through the ODE solver.
"""

from hybrid_jax.identification.fitting import Identified, identify, identify_in_turn, prediction_errors
from hybrid_jax.identification.recordings import Layout

__all__ = ["Identified", "Layout", "identify", "identify_in_turn", "prediction_errors"]
