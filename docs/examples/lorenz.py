"""Find the three parameters of the Lorenz system from noisy samples."""

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import hybrid_jax as hj
from hybrid_jax.trajectories import windows_of


class Lorenz(hj.AbstractVectorField):  # x = three coordinates
    sigma: jax.Array
    rho: jax.Array
    beta: jax.Array

    def __call__(self, x, u):
        return jnp.stack(
            [
                self.sigma * (x[1] - x[0]),
                x[0] * (self.rho - x[2]) - x[1],
                x[0] * x[1] - self.beta * x[2],
            ]
        )


def lorenz(*values):
    return Lorenz(*(jnp.array(value) for value in values))


start, u = jnp.array([1.0, 1.0, 25.0]), np.zeros((2000, 0), "f4")
states = np.vstack(
    [start, hj.rollout(lorenz(10.0, 28.0, 8 / 3), start, u, 0.01)]
)
noisy = (
    states + 0.1 * np.random.default_rng(0).normal(size=states.shape)
).astype("f4")

windows = windows_of(noisy, u, dt=0.01, steps=10)
fitted = hj.fit_least_squares(lorenz(8.0, 20.0, 2.0), windows)
for name, one in hj.intervals(
    fitted.field, hj.covariance_of(fitted.field, windows)
).items():
    print(f"{name}: {one.value:.2f} ({one.low:.2f} to {one.high:.2f})")

axes = plt.figure(figsize=(4.2, 3.2), layout="constrained").add_subplot(
    projection="3d"
)
axes.plot(*noisy.T, ".", ms=1, color="0.6", label="samples")
axes.plot(
    *hj.rollout(fitted.field, start, u[:500], 0.01).T,
    color="#0072B2",
    label="fitted model, 5 s",
)
axes.set(xlabel="x", ylabel="y", zlabel="z")
axes.legend(fontsize=7, frameon=False)
plt.savefig("lorenz.png", dpi=100)
