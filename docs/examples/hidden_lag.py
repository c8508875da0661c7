"""A motor lags behind its command: the lag is a hidden state."""

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import hybrid_jax as hj
from hybrid_jax.dynamics import Lag


class Cart(hj.AbstractVectorField):  # x = [place, speed], u = [force]
    log_mass: jax.Array

    def __call__(self, x, u):
        return jnp.stack([x[1], (u[0] - 0.4 * x[1]) / jnp.exp(self.log_mass)])


def model(mass, lag):
    field = hj.with_hidden(
        Cart(jnp.log(jnp.array(mass))),
        Lag(jnp.log(jnp.array([lag])), places=(0,)),
    )
    return hj.StateSpaceModel(
        field,
        ("force",),
        {"place": lambda x, u: x[0]},
        start=(0.0, 0.0, 0.0),
        spread=(0, 0, 0),
    )


random = np.random.default_rng(0)
commands, times = np.arange(0, 12, 0.4), np.arange(0, 12, 0.05)
force = random.choice([-1.0, 1.0], size=30)
empty = hj.Record.of(
    "truth", force=(commands, force), place=(times, 0 * times)
)
true = hj.simulate(model(0.5, 0.25), empty, dt=0.01)[0]["place"][:, 0]
place = true + 0.005 * random.normal(size=len(times))
record = hj.Record.of("run", force=(commands, force), place=(times, place))

result = hj.fit_records(model(1.0, 0.1), [record], dt=0.02)
for name, one in result.intervals.items():
    print(f"{name}: {one.value:.3f} ({one.low:.3f} to {one.high:.3f})")
mass, lag = (float(np.exp(one.value)) for one in result.intervals.values())
print(f"mass {mass:.2f} kg, true 0.50; lag {lag:.2f} s, true 0.25")

fitted = hj.simulate(result.model, empty, dt=0.02)[0]["place"][:, 0]
without = hj.simulate(model(0.5, 1e-3), empty, dt=0.001)[0]["place"][:, 0]
plt.rc("axes.spines", top=False, right=False)
plt.figure(figsize=(4.2, 2.8), layout="constrained")
plt.plot(times, place, "o", ms=5, color="0.8", label="measured")
plt.plot(times, without, color="0.45", ls="--", label="without a lag")
plt.plot(times, fitted, color="#0072B2", label="with the lag that was found")
plt.xlabel("time [s]")
plt.ylabel("position [m]")
plt.legend(fontsize=7, frameon=False)
plt.savefig("hidden_lag.png", dpi=110)
