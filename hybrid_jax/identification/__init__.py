"""Learn a vehicle from its flights, or identify it from recordings of its commands and sensors."""

from hybrid_jax.identification.adaptation import adapted
from hybrid_jax.identification.fitting import Identified, identify, identify_in_turn, window_errors
from hybrid_jax.identification.learning import Learned, learn
from hybrid_jax.identification.recordings import Layout

__all__ = ["Identified", "Layout", "Learned", "adapted", "identify", "identify_in_turn", "learn", "window_errors"]
