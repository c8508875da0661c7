"""A rotor loses 15 % of its thrust: which one, and how much?"""

import equinox as eqx
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import hybrid_jax as hj
from hybrid_jax.control import Controller, advance, figure_eight, sample
from hybrid_jax.trajectories import windows_of

controller, model = Controller(hj.IRIS), hj.rigid_body(hj.IRIS)
share = jnp.array([1.0, 1.0, 0.85, 1.0])


# Thrust and torque grow with the square of a rotor's speed.
def damaged(x, u):
    return model(x, u * jnp.sqrt(share))


reference = sample(figure_eight(top_speed=2.0), controller, duration=4.0)
control, simulate = (
    eqx.filter_jit(controller),
    eqx.filter_jit(lambda x, u: advance(damaged, x, u, controller.period)),
)
plan, x = controller.begin(), reference[0]
states, inputs = [x], []
for i in range(400):
    u, plan = control(model, controller.horizon(reference, i), x, plan)
    x = simulate(x, u)
    states, inputs = [*states, x], [*inputs, u]

noise = np.repeat(
    [0.001, 0.002, 0.01, 0.01], [3, 4, 3, 3]
) * np.random.default_rng(0).normal(size=(401, 13))
windows = windows_of(
    np.array(states) + noise, np.array(inputs), dt=controller.period, steps=10
)
result = hj.adapt(model, windows)
print(result.report())

found = [result.parameters[f"efficiency[{i}]"] for i in range(4)]
plt.rc("axes.spines", top=False, right=False)
plt.figure(figsize=(4.2, 2.8), layout="constrained")
true = {"color": "0.8", "lw": 6, "label": "true"}
plt.hlines(100 * share, np.arange(4) - 0.3, np.arange(4) + 0.3, **true)
for i, one in enumerate(found):
    plt.plot([i, i], [100 * one.low, 100 * one.high], color="#CC79A7", lw=3)
    plt.plot(
        i,
        100 * one.value,
        "o",
        color="#CC79A7",
        label="" if i else "estimate, 95 % interval",
    )
plt.xticks(range(4), [f"rotor {i}" for i in range(4)])
plt.ylabel("thrust [% of nominal]")
plt.ylim(80, 106)
plt.legend(fontsize=7, ncols=2, frameon=False)
plt.savefig("weak_rotor.png", dpi=110)
