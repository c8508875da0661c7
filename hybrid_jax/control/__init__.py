"""Closed-loop flight with any vector field: model predictive controller, references, disturbance observer, simulation.

An example with your own vehicle, a model of it, and a simulator or a radio link that applies the rotor speeds:

    import equinox as eqx
    import hybrid_jax as hj
    from hybrid_jax.control import Controller, advance, figure_eight, sample

    vehicle = hj.Vehicle(
        mass=0.8, inertia=(4e-3, 4e-3, 7e-3), thrust_coefficient=3e-6, torque_coefficient=5e-8, max_rotor_speed=1600.0,
        rotor_positions=((0.1, -0.1), (-0.1, 0.1), (0.1, 0.1), (-0.1, -0.1)), spin=(-1.0, -1.0, 1.0, 1.0),
    )
    model = hj.rigid_body(vehicle)  # or an adapted model: hj.load("adapted.npz").field
    controller = Controller(vehicle)
    reference = sample(figure_eight(top_speed=3.0), controller, duration=2.0)

    control, simulate = eqx.filter_jit(controller), eqx.filter_jit(advance)
    plan, x = controller.begin(), reference[0]
    for i in range(200):  # every 0.01 s
        u, plan = control(model, controller.horizon(reference, i), x, plan)
        x = simulate(model, x, u, controller.period)  # or: send u, wait, estimate x
    print("after 2 s", abs(x - reference[200])[:3].max(), "m off")

`fly` does the same in one compiled program, with the observer. `open_loop_costs` compares the predicted cost of plans
with the actual one.
"""

from hybrid_jax.control.controller import Controller, Plan
from hybrid_jax.control.cost import Weights
from hybrid_jax.control.loop import Flight, Performance, fly, performance
from hybrid_jax.control.open_loop import OpenLoopCosts, open_loop_costs, relative_cost_error
from hybrid_jax.control.references import add_body_rates, figure_eight, hover, low_pass, sample, step
from hybrid_jax.control.sensitivities import advance

__all__ = [
    "Controller",
    "Flight",
    "OpenLoopCosts",
    "Performance",
    "Plan",
    "Weights",
    "add_body_rates",
    "advance",
    "figure_eight",
    "fly",
    "hover",
    "low_pass",
    "open_loop_costs",
    "performance",
    "relative_cost_error",
    "sample",
    "step",
]
