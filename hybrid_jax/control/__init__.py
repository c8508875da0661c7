"""Closed-loop flight with any vector field: predictive controller, references, disturbance observer, simulation."""

from hybrid_jax.control.controller import Controller, Plan
from hybrid_jax.control.cost import Weights
from hybrid_jax.control.loop import Flight, Hardware, Loop, Performance, fly, open_loop_costs, performance
from hybrid_jax.control.observer import Observer
from hybrid_jax.control.references import add_body_rates, figure_eight, hover, low_flyby, sample, step
from hybrid_jax.control.sensitivities import advance, lagged_speeds

__all__ = ["Controller", "Flight", "Hardware", "Loop", "Observer", "Performance", "Plan", "Weights"]
__all__ += ["advance", "fly", "lagged_speeds", "open_loop_costs", "performance"]
__all__ += ["add_body_rates", "figure_eight", "hover", "low_flyby", "sample", "step"]
