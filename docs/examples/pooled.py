"""When is an interval right? Hybrids, pooled, and complete physics."""

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
    x0, u = draw(size=(count, 1)), draw(size=(count, 10, 1))
    x = hj.rollout_batch(Cart(friction, 0.1), x0, u, 0.1)
    x = x + 0.01 * draw(size=(count, 10, 1))
    return hj.Trajectories(x0, u, x, dt=0.1)


before, stop = windows(0.2, 200, 0), windows(0.2, 50, 1)
after = windows(0.5, 30, 2)
size = {"hidden": 8, "norm": "none", "activation": "tanh"}
results = []
for seed in range(4):
    key = jax.random.key(seed)
    network = hj.residual_network(1, 1, key, **size)
    model = hj.Hybrid(Cart(jnp.array(0.2)), network)
    source = hj.fit(model, before, stop, key, max_epochs=40)
    results.append(hj.adapt(source.best, after, method="theta_least_squares"))
pooled = hj.pool(results)["friction"]
known = Cart(jnp.array(0.2), jnp.array(0.0))
complete = hj.adapt(known, after, method="least_squares").parameters[
    "friction"
]
print("pooled:", pooled)
print("complete physics:", complete)

found = [one.parameters["friction"] for one in results]
shown = {f"hybrid {i}": one for i, one in enumerate(found, 1)}
shown |= {"hybrids, pooled": pooled, "complete physics": complete}
colours = 4 * ["#0072B2"] + ["#CC79A7", "#009E73"]
plt.rc("axes.spines", top=False, right=False)
plt.figure(figsize=(4.2, 2.8), layout="constrained")
for y, one in enumerate(shown.values()):
    plt.plot([one.low, one.high], [y, y], color=colours[y], lw=3)
    plt.plot(one.value, y, "o", color=colours[y])
plt.yticks(range(len(shown)), shown)
plt.axvline(0.5, color="0.4", ls=":", label="true value")
plt.xlabel("friction, 95 % interval [1/s]")
plt.legend(fontsize=7, frameon=False)
plt.savefig("pooled.png", dpi=110)
