"""Closed-loop flight with any vector field: model predictive controller, references, disturbance observer, simulation.

`Controller` is called once per period, `fly` closes the loop in one compiled program, with the observer, and
`open_loop_costs` compares the predicted cost of plans with the actual one. An example: docs/howto/control.md.
"""

from hybrid_jax.control.controller import Controller, Plan
from hybrid_jax.control.cost import Weights
from hybrid_jax.control.loop import (
    Flight,
    Hardware,
    Loop,
    OpenLoopCosts,
    Performance,
    fly,
    open_loop_costs,
    performance,
    relative_cost_error,
)
from hybrid_jax.control.observer import Observer
from hybrid_jax.control.references import add_body_rates, figure_eight, hover, low_flyby, sample, step
from hybrid_jax.control.rotor_lag import lagged_speeds
from hybrid_jax.control.sensitivities import advance

__all__ = ["Controller", "Flight", "Hardware", "Loop", "Observer", "OpenLoopCosts", "Performance"]
__all__ += ["Plan", "Weights", "lagged_speeds"]
__all__ += ["advance", "fly", "open_loop_costs", "performance", "relative_cost_error"]
__all__ += ["add_body_rates", "figure_eight", "hover", "low_flyby", "sample", "step"]
