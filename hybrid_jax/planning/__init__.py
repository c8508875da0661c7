"""Plan the most informative experiment before you fly it: `excitation`."""

from hybrid_jax.planning.input_designs import FlightBounds, InputBounds
from hybrid_jax.planning.optimal_design import Excitation, excitation

__all__ = ["Excitation", "FlightBounds", "InputBounds", "excitation"]
