"""Adapt a pendulum that became longer to ten seconds of new data."""

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt

import hybrid_jax as hj


class Pendulum(hj.AbstractVectorField):  # x = [angle, rate], u = [push]
    log_length: jax.Array

    def __call__(self, x, u):
        stiffness = 9.81 / jnp.exp(self.log_length)
        return jnp.stack([x[1], u[0] - stiffness * jnp.sin(x[0])])


def damped(length):
    exact = Pendulum(jnp.log(length))
    return lambda x, u: exact(x, u) - jnp.stack([0.0, 0.3 * x[1]])


def windows(length, count, seed):
    starts, inputs = jax.random.split(jax.random.key(seed))
    x0 = jax.random.normal(starts, (count, 2))
    u = jax.random.normal(inputs, (count, 10, 1))
    x = hj.rollout_batch(damped(length), x0, u, 0.05)
    return hj.Trajectories(x0, u, x, dt=0.05)


size = {"hidden": 16, "norm": "none", "activation": "tanh"}
network = hj.residual_network(2, 1, jax.random.key(4), **size)
model = hj.Hybrid(Pendulum(jnp.log(1.0)), network)
train, stop, key = (
    windows(0.7, 300, 0),
    windows(0.7, 100, 1),
    jax.random.key(5),
)
source = hj.fit(model, train, stop, key, max_epochs=200).best
result = hj.adapt(source, windows(0.8, 20, 2))
print(result.report())

start, push = jnp.array([1.5, 0.0]), jnp.zeros((100, 1))
time = 0.05 * jnp.arange(1, 101)
plt.rc("axes.spines", top=False, right=False)
plt.figure(figsize=(4.2, 2.8), layout="constrained")
shown = {
    "true": (damped(0.8), {"color": "0.75", "lw": 5}),
    "not adapted": (source, {"color": "0.45", "ls": "--"}),
    "adapted": (result.field, {"color": "#CC79A7"}),
}
for label, (field, style) in shown.items():
    angle = hj.rollout(field, start, push, 0.05)[:, 0]
    plt.plot(time, angle, label=label, **style)
plt.xlabel("time [s]")
plt.ylabel("angle [rad]")
plt.legend(ncols=3, fontsize=7, loc="upper right", frameon=False)
plt.savefig("adapt_pendulum.png", dpi=110)
