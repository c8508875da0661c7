"""A field on a grid: a network learns the reaction that physics lacks."""

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import hybrid_jax as hj

# Two quantities on a periodic square.
grid = hj.Grid((16, 16), spacing=2 / 16, components=2)
solver = hj.RK4(substeps=2)


def fitzhugh_nagumo(x, u):
    first, second = grid.fields(x)
    reaction = jnp.stack([first - first**3 - 5e-3 - second, first - second])
    return hj.diffusion(grid, (1e-3, 5e-3))(x, u) + reaction.reshape(x.shape)


def windows(x0, steps):
    u = np.zeros((len(x0), steps, 0), "f4")
    fine = hj.RK4(substeps=20)
    x = hj.rollout_batch(fitzhugh_nagumo, x0, u, 0.1, fine)
    return hj.Trajectories(x0, u, np.asarray(x), dt=0.1)


rough = np.random.default_rng(0).random((2, grid.size)).astype("f4")
angle = np.linspace(0, 2 * np.pi, 16, endpoint=False)
first = np.outer(np.cos(angle), np.sin(angle))
second = np.outer(np.sin(2 * angle), np.cos(angle))
waves = 0.5 + 0.4 * np.concatenate([first, second]).reshape(1, -1)
train, test = windows(rough, 5), windows(waves.astype("f4"), 10)
network = hj.grid_network(grid, 0, jax.random.key(0), kernel=1, hidden=8)
# Wrong by a factor of two.
model = hj.Hybrid(hj.diffusion(grid, (2e-3, 2.5e-3)), network)
fitted = hj.fit_gauss_newton(model, train, solver=solver, max_steps=12).field
print(fitted.physics.theta(), "true: 1e-3, 5e-3")

predicted = hj.rollout_batch(fitted, test.x0, test.u, test.dt, solver)
fields = [grid.fields(jnp.asarray(x[0, -1]))[0] for x in (test.x, predicted)]
shown = {
    "true": fields[0],
    "predicted": fields[1],
    "|error|": jnp.abs(fields[0] - fields[1]),
}
figure, panels = plt.subplots(1, 3, figsize=(4.6, 2.4), layout="constrained")
for axes, (title, image) in zip(panels, shown.items(), strict=True):
    bar = figure.colorbar(axes.imshow(image), ax=axes, location="bottom")
    bar.locator = plt.MaxNLocator(3)
    bar.ax.tick_params(labelsize=5)
    axes.set_title(title, fontsize=8)
    axes.set_axis_off()
figure.suptitle("concentration u after 1 s\n", fontsize=8)
plt.savefig("reaction.png", dpi=110)
