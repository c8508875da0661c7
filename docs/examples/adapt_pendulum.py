"""Adapt a pendulum that became longer: ten seconds of data repair the model."""

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt

import hybrid_jax as hj


class Pendulum(hj.AbstractVectorField):  # x = [angle, rate], u = [acceleration]
    log_length: jax.Array

    def __call__(self, x, u):
        return jnp.stack([x[1], u[0] - 9.81 / jnp.exp(self.log_length) * jnp.sin(x[0])])


def damped(length):
    return lambda x, u: Pendulum(jnp.log(length))(x, u) - jnp.stack([0.0, 0.3 * x[1]])


def windows(length, count, seed):
    starts, inputs = jax.random.split(jax.random.key(seed))
    x0, u = jax.random.normal(starts, (count, 2)), jax.random.normal(inputs, (count, 10, 1))
    return hj.Trajectories(x0, u, hj.rollout_batch(damped(length), x0, u, 0.05), dt=0.05)


network = hj.residual_network(2, 1, jax.random.key(4), hidden=16, norm="none", activation="tanh")
model = hj.Hybrid(Pendulum(jnp.log(1.0)), network)
source = hj.fit(model, windows(0.7, 300, 0), windows(0.7, 100, 1), jax.random.key(5), max_epochs=200).best
result = hj.adapt(source, windows(0.8, 20, 2))
print(result.report())

start, push = jnp.array([1.5, 0.0]), jnp.zeros((100, 1))
time = 0.05 * jnp.arange(1, 101)
plt.figure(figsize=(4.2, 2.8), layout="constrained")
plt.plot(time, hj.rollout(damped(0.8), start, push, 0.05)[:, 0], color="0.75", lw=5, label="true")
plt.plot(time, hj.rollout(source, start, push, 0.05)[:, 0], color="0.45", ls="--", label="not adapted")
plt.plot(time, hj.rollout(result.field, start, push, 0.05)[:, 0], color="#CC79A7", label="adapted")
plt.xlabel("time [s]")
plt.ylabel("angle [rad]")
plt.legend(ncols=3, fontsize=7, loc="upper right")
plt.savefig("adapt_pendulum.png", dpi=110)
