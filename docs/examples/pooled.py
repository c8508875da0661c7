"""When is an interval right? Compare hybrids, whose physics lacks a force, with complete physics."""

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import hybrid_jax as hj


class Cart(hj.AbstractVectorField):  # x = [speed], u = [force]
    friction: jax.Array
    air: jax.Array | float = 0.0  # an array is learned, a number is not

    def __call__(self, x, u):
        return u - self.friction * x - self.air * x * jnp.abs(x)


def windows(friction, count, seed):
    draw = np.random.default_rng(seed).normal
    x0, u = draw(size=(count, 1)).astype("f4"), draw(size=(count, 10, 1)).astype("f4")
    x = hj.rollout_batch(Cart(friction, 0.1), x0, u, 0.1) + 0.01 * draw(size=(count, 10, 1))
    return hj.Trajectories(x0, u, x.astype("f4"), dt=0.1)


before, stop, after = windows(0.2, 200, 0), windows(0.2, 50, 1), windows(0.5, 30, 2)
results = []
for seed in range(4):
    network = hj.residual_network(1, 1, jax.random.key(seed), hidden=8, norm="none", activation="tanh")
    source = hj.fit(hj.Hybrid(Cart(jnp.array(0.2)), network), before, stop, jax.random.key(seed), max_epochs=40)
    results.append(hj.adapt(source.best, after, method="theta_least_squares"))
pooled = hj.pool(results)["friction"]
complete = hj.adapt(Cart(jnp.array(0.2), jnp.array(0.0)), after, method="least_squares").parameters["friction"]
print("pooled:", pooled)
print("complete physics:", complete)

shown = {f"hybrid {i + 1}": one.parameters["friction"] for i, one in enumerate(results)}
shown |= {"hybrids, pooled": pooled, "complete physics": complete}
plt.figure(figsize=(4.2, 2.8), layout="constrained")
for y, (name, one) in enumerate(shown.items()):
    colour = "#0072B2" if "hybrid " in name else "#009E73" if one is complete else "#CC79A7"
    plt.plot([one.low, one.high], [y, y], color=colour, lw=3)
    plt.plot(one.value, y, "o", color=colour)
plt.yticks(range(len(shown)), shown)
plt.axvline(0.5, color="0.4", ls=":", label="true value")
plt.xlabel("friction, 95 % interval [1/s]")
plt.legend(fontsize=7)
plt.savefig("pooled.png", dpi=110)
