"""Adapt while it runs: a filter finds that a mass doubled."""

import equinox as eqx
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import hybrid_jax as hj


class Cart(hj.AbstractVectorField):  # x = [place, speed], u = [force]
    log_mass: jax.Array

    def __call__(self, x, u):
        return jnp.stack([x[1], u[0] / jnp.exp(self.log_mass)])


dt, noise = 0.02, (0.002, 0.02)
random = np.random.default_rng(0)
force = np.repeat(
    random.choice([-2.0, 2.0], size=(30, 1)), 20, axis=0
).astype("f4")
light, heavy = Cart(jnp.log(1.0)), Cart(jnp.log(2.0))
first = hj.rollout(light, jnp.zeros(2), force[:300], dt)
# It changes after 6 s.
states = np.vstack([first, hj.rollout(heavy, first[-1], force[300:], dt)])
samples = (states + noise * random.normal(size=states.shape)).astype("f4")

online = hj.OnlineAdaptation(light, dt=dt, noise=noise, prior=0.5)
update, state, found = (
    eqx.filter_jit(online.update),
    online.begin(jnp.zeros(2)),
    [],
)
for x, u in zip(samples, force, strict=True):
    state = update(state, x, u)
    found.append(online.intervals(state)["log_mass"])
value, low, high = (
    np.exp([getattr(one, name) for one in found])
    for name in ("value", "low", "high")
)
print(f"mass {value[299]:.2f} before, {value[-1]:.2f} kg after")

time = dt * np.arange(len(samples))
plt.rc("axes.spines", top=False, right=False)
plt.figure(figsize=(4.2, 2.8), layout="constrained")
plt.step(
    [0, 6, 12], [1, 2, 2], where="post", color="0.75", lw=5, label="true"
)
plt.plot(time, value, color="#CC79A7", label="estimate")
plt.fill_between(
    time, low, high, color="#CC79A7", alpha=0.25, lw=0, label="95 % interval"
)
plt.xlabel("time [s]")
plt.ylabel("mass [kg]")
plt.ylim(0.5, 3)
plt.legend(fontsize=7, loc="upper left", frameon=False)
plt.savefig("online.png", dpi=110)
