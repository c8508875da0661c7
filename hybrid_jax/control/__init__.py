"""Closed-loop flight with any vector field: a predictive controller, references, a disturbance observer, the loop.

Your own vehicle, with a model of it and whatever turns rotor speeds into the next state, a simulator or a radio:

    import equinox as eqx
    import hybrid_jax as hj
    from hybrid_jax.control import Controller, advance, figure_eight, sample

    vehicle = hj.Vehicle(
        mass=0.8, inertia=(4e-3, 4e-3, 7e-3), thrust_coefficient=3e-6, torque_coefficient=5e-8, max_rotor_speed=1600.0,
        rotor_positions=((0.1, -0.1), (-0.1, 0.1), (0.1, 0.1), (-0.1, -0.1)), spin=(-1.0, -1.0, 1.0, 1.0),
    )
    model = hj.rigid_body(vehicle)  # or what was adapted to its flight: hj.load("adapted.npz").field
    controller = Controller(vehicle)
    reference = sample(figure_eight(top_speed=3.0), controller, duration=2.0)

    control, simulate = eqx.filter_jit(controller), eqx.filter_jit(advance)
    plan, x = controller.begin(), reference[0]
    for i in range(200):  # every 0.01 s
        u, plan = control(model, controller.horizon(reference, i), x, plan)
        x = simulate(model, x, u, controller.period)  # or: send u, wait, estimate x
    print("after 2 s", abs(x - reference[200])[:3].max(), "m off")

`loop.fly` does that in one compiled program, with the observer, for many lanes at once.
"""

from hybrid_jax.control.controller import Controller, Plan
from hybrid_jax.control.cost import Weights
from hybrid_jax.control.loop import Flight, Performance, fly, performance, realised
from hybrid_jax.control.references import figure_eight, hover, low_pass, sample, step, upset
from hybrid_jax.control.sensitivities import advance

__all__ = [
    "Controller",
    "Flight",
    "Performance",
    "Plan",
    "Weights",
    "advance",
    "figure_eight",
    "fly",
    "hover",
    "low_pass",
    "performance",
    "realised",
    "sample",
    "step",
    "upset",
]
