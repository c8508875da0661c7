"""Fly a figure-8 with model predictive control, adapt, and fly again."""

import equinox as eqx
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import hybrid_jax as hj
from hybrid_jax.control import Controller, advance, figure_eight, sample
from hybrid_jax.trajectories import windows_of

controller = Controller(hj.IRIS)
nominal = hj.rigid_body(hj.IRIS)
# 30 % heavier.
heavy = hj.RigidBody(
    {"Ix": jnp.array(0.0), "Iy": jnp.array(0.0), "k": jnp.log(1 / 1.3)},
    hj.IRIS,
)
reference = sample(figure_eight(top_speed=2.0), controller, duration=4.0)
control, simulate = eqx.filter_jit(controller), eqx.filter_jit(advance)


def flown(model):
    """States (401, 13) and rotor speeds (400, 4) of a flight with a model."""
    plan, states, inputs = controller.begin(), [reference[0]], []
    for i in range(400):
        u, plan = control(
            model, controller.horizon(reference, i), states[-1], plan
        )
        states, inputs = (
            [*states, simulate(heavy, states[-1], u, controller.period)],
            [*inputs, u],
        )
    return np.array(states), np.array(inputs)


first, inputs = flown(nominal)
result = hj.adapt(
    nominal,
    windows_of(first, inputs, dt=controller.period, steps=10),
    method="theta_least_squares",
)
print(result.report())
second, _ = flown(result.field)

time = controller.period * np.arange(401)
plt.rc("axes.spines", top=False, right=False)
plt.figure(figsize=(4.2, 2.8), layout="constrained")
for name, states, style in (
    ("not adapted", first, {"color": "0.45", "ls": "--"}),
    ("adapted", second, {"color": "#CC79A7"}),
):
    wanted = np.array(reference)[:401, :3]
    error = 100 * np.linalg.norm(states[:, :3] - wanted, axis=1)
    most = f"{name}: at most {error.max():.1g} cm"
    plt.plot(time, error, label=most, **style)
plt.xlabel("time [s]")
plt.ylabel("distance from the figure-8 [cm]")
plt.legend(fontsize=7, frameon=False)
plt.savefig("figure_eight.png", dpi=110)
