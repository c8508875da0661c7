"""Identify a vehicle from recordings of its commands and sensors, by fitting its parameters through the ODE solver."""

from hybrid_jax.identification.fitting import Identified, identify, identify_in_turn, window_errors
from hybrid_jax.identification.recordings import Layout

__all__ = ["Identified", "Layout", "identify", "identify_in_turn", "window_errors"]
