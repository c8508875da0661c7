"""Plan the experiment that tells parameters best, before it is made: `excitation`."""

from hybrid_jax.planning.input_designs import FlightBounds, InputBounds
from hybrid_jax.planning.optimal_design import Excitation, excitation

__all__ = ["Excitation", "FlightBounds", "InputBounds", "excitation"]
