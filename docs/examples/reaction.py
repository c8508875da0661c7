"""A field on a grid: diffusion is known up to a number, and a network learns the reaction."""

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import hybrid_jax as hj

grid = hj.Grid((16, 16), spacing=2 / 16, components=2)  # two quantities on a periodic square
solver = hj.RK4(substeps=2)


def fitzhugh_nagumo(x, u):
    first, second = grid.fields(x)
    reaction = jnp.stack([first - first**3 - 5e-3 - second, first - second])
    return hj.diffusion(grid, (1e-3, 5e-3))(x, u) + reaction.reshape(x.shape)


def windows(x0, steps):
    u = np.zeros((len(x0), steps, 0), "f4")
    return hj.Trajectories(
        x0, u, np.asarray(hj.rollout_batch(fitzhugh_nagumo, x0, u, 0.1, hj.RK4(substeps=20))), dt=0.1
    )


rough = np.random.default_rng(0).random((2, grid.size)).astype("f4")
angle = np.linspace(0, 2 * np.pi, 16, endpoint=False)
waves = np.concatenate([np.outer(np.cos(angle), np.sin(angle)), np.outer(np.sin(2 * angle), np.cos(angle))])
train, test = windows(rough, 5), windows((0.5 + 0.4 * waves).reshape(1, -1).astype("f4"), 10)
network = hj.grid_network(grid, 0, jax.random.key(0), kernel=1, hidden=8)
model = hj.Hybrid(hj.diffusion(grid, (2e-3, 2.5e-3)), network)  # wrong by a factor of two
fitted = hj.fit_gauss_newton(model, train, solver=solver, max_steps=12).field
print(fitted.physics.theta(), "true: 1e-3, 5e-3")

predicted = hj.rollout_batch(fitted, test.x0, test.u, test.dt, solver)
fields = [grid.fields(jnp.asarray(x[0, -1]))[0] for x in (test.x, predicted)]
shown = {"true": fields[0], "predicted": fields[1], "|error|": jnp.abs(fields[0] - fields[1])}
figure, panels = plt.subplots(1, 3, figsize=(4.6, 2.1), layout="constrained")
for axes, (title, image) in zip(panels, shown.items(), strict=True):
    figure.colorbar(axes.imshow(image), ax=axes, location="bottom").ax.tick_params(labelsize=5, rotation=30)
    axes.set_title(title, fontsize=8)
    axes.set_axis_off()
figure.suptitle("concentration u after 1 s", fontsize=8)
plt.savefig("reaction.png", dpi=110)
