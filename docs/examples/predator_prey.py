"""Predator and prey: a network learns what happens when they meet."""

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import hybrid_jax as hj
from hybrid_jax.trajectories import windows_of


class Growth(hj.AbstractVectorField):  # x = [prey, predators]
    birth: jax.Array
    death: jax.Array

    def __call__(self, x, u):
        return jnp.stack([self.birth * x[0], -self.death * x[1]])


def meeting(x):
    return jnp.stack([-0.9 * x[0] * x[1], 0.8 * x[0] * x[1]])


true = lambda x, u: Growth(jnp.array(1.3), jnp.array(1.8))(x, u) + meeting(x)
starts = np.array([[0.5, 1.0], [4.0, 1.0], [1.0, 3.0], [2.0, 0.5]], "f4")
u = np.zeros((60, 0), "f4")
recorded = [
    np.vstack([start, hj.rollout(true, start, u, 0.1)]) for start in starts
]
data = hj.trajectories.concatenate(
    [windows_of(states, u, dt=0.1, steps=5) for states in recorded]
)

network = hj.residual_network(
    2, 0, jax.random.key(0), hidden=10, norm="none", activation="tanh"
)
model = hj.with_scaling(
    hj.Hybrid(Growth(jnp.array(1.0), jnp.array(1.0)), network), data
)
fitted = hj.fit_gauss_newton(model, data, max_steps=60).field

time, long = 0.1 * np.arange(1, 201), np.zeros((200, 0), "f4")
plt.rc("axes.spines", top=False, right=False)
plt.figure(figsize=(4.2, 2.8), layout="constrained")
plt.axvspan(0, 6, color="0.93", label="data")
exact, found = (hj.rollout(f, starts[0], long, 0.1) for f in (true, fitted))
for i, (name, dash) in enumerate({"prey": "-", "predators": "--"}.items()):
    plt.plot(time, exact[:, i], color="0.75", lw=5, label="true" if i else "")
    plt.plot(time, found[:, i], dash, color="#0072B2", label=f"{name}, model")
plt.xlabel("time (scaled)")
plt.ylabel("population (scaled)")
plt.legend(fontsize=7, ncols=2, loc="upper right", frameon=False)
plt.ylim(top=9.5)
plt.savefig("predator_prey.png", dpi=110)
error = jnp.abs(found - exact).max()
print(f"largest error in {time[-1]:.0f} units of time: {error:.2g}")
