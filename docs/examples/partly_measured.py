"""Only the angle is measured, with a gap: estimate the rest."""

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import hybrid_jax as hj


class Pendulum(hj.AbstractVectorField):  # x = [angle, rate], u = [push]
    log_length: jax.Array
    damping: jax.Array

    def __call__(self, x, u):
        pull = 9.81 / jnp.exp(self.log_length) * jnp.sin(x[0])
        return jnp.stack([x[1], u[0] - pull - self.damping * x[1]])


def model(length, damping, spread):
    field = Pendulum(jnp.log(jnp.array(length)), jnp.array(damping))
    return hj.StateSpaceModel(
        field,
        ("push",),
        {"angle": lambda x, u: x[0]},
        start=(0.5, 0.0),
        spread=spread,
    )


random = np.random.default_rng(0)
push_times, times = np.arange(0, 10, 0.1), np.sort(random.uniform(0, 10, 150))
push = 2 * random.normal(size=100)
times[0] = 0.0
empty = hj.Record.of(
    "truth", push=(push_times, push), angle=(times, 0 * times)
)
true = hj.simulate(model(0.8, 0.3, (0, 0)), empty, dt=0.01)[0]["angle"][:, 0]
angle = true + 0.02 * random.normal(size=150)
angle[(times > 4) & (times < 6)] = np.nan  # the sensor failed

record = hj.Record.of("flight", push=(push_times, push), angle=(times, angle))
result = hj.fit_records(model(1.0, 0.1, (np.inf, np.inf)), [record], dt=0.02)
for name, one in result.intervals.items():
    print(f"{name}: {one.value:.3f} ({one.low:.3f} to {one.high:.3f})")

fitted = hj.simulate(result.model, empty, dt=0.02)[0]["angle"][:, 0]
plt.rc("axes.spines", top=False, right=False)
plt.figure(figsize=(4.2, 2.8), layout="constrained")
plt.axvspan(4, 6, color="0.93", label="no samples")
plt.plot(times, true, color="0.75", lw=5, label="true")
plt.plot(times, angle, ".", color="0.2", ms=4, label="measured")
plt.plot(times, fitted, color="#0072B2", label="model")
plt.xlabel("time [s]")
plt.ylabel("angle [rad]")
plt.legend(ncols=2, fontsize=7, framealpha=1)
plt.savefig("partly_measured.png", dpi=110)
