"""How long does a gradient step of a field on a grid take, and in how much memory, against the same written plainly?

A step is one trajectory of 25 intervals of 0.1 s, two steps of RK4 each, of 32 × 32 points with two components: 2048
states. The plain one has the Laplacian by rolls, the network as it reads, RK4 by hand in a scan, and gradients by
autodiff, which keeps all hidden units; ours computes them again.
"""

from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax

import hybrid_jax as hj
from benchmarks.timing import Findings, Ratio, agree, compiled, compiled_with_memory, in_turns, run, table
from hybrid_jax.dynamics.base import ravel_learned, trainable
from hybrid_jax.training.fitting import gradient_step, make_run_config, start
from hybrid_jax.training.gauss_newton import with_sensitivities

DT, SUBSTEPS, RATE = 0.1, 2, 1e-3
# Sums over 25 intervals of 2048 states in another order, in float32.
AGREEMENT = 1e-3


@dataclass(frozen=True)
class Preset:
    """Kernels of the network, points along each axis, intervals, hidden units, and turns."""

    kernels: tuple[int, ...]
    points: int
    intervals: int
    hidden: int
    turns: int


PRESETS = {"full": Preset((1, 3), 32, 25, 16, turns=20), "smoke": Preset((1, 3), 8, 2, 4, turns=2)}


def hybrid(kernel: int, preset: Preset) -> hj.Hybrid:
    grid = hj.Grid((preset.points, preset.points), 2 / preset.points, 2)
    network = hj.grid_network(grid, 0, jax.random.key(0), kernel=kernel, hidden=preset.hidden)
    return hj.Hybrid(hj.diffusion(grid, (1e-3, 5e-3)), network)


def plain_slope(field: Any, x):
    """ẋ of one sample, as it reads."""
    grid, network, kernel = field.physics.grid, field.residual.network, field.residual.kernel
    fields = x.reshape(grid.components, *grid.shape)
    rolls = [(i, j) for i in range(kernel // 2, -kernel // 2, -1) for j in range(kernel // 2, -kernel // 2, -1)]
    near = jnp.concatenate([jnp.roll(fields, shift, (1, 2)) for shift in rolls]).reshape(-1, grid.points)
    hidden = jnp.tanh(network.weight_in @ near + network.norm.shift[:, None])
    reaction = network.weight_out @ hidden + network.bias_out[:, None]
    around = sum(jnp.roll(fields, step, axis) for axis in (1, 2) for step in (1, -1)) - 4 * fields
    spread = jnp.exp(field.physics.log_diffusivity)[:, None, None] * around / grid.spacing**2
    return spread.ravel() + reaction.ravel()


def plain_step(field, adam, windows):
    def forecast(field, x0):
        def substep(x, _):
            h, f = DT / SUBSTEPS, partial(plain_slope, field)
            k1 = f(x)
            k2 = f(x + h / 2 * k1)
            k3 = f(x + h / 2 * k2)
            k4 = f(x + h * k3)
            return x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4), None

        def interval(x, _):
            x = jax.lax.scan(substep, x, None, length=SUBSTEPS)[0]
            return x, x

        return jax.lax.scan(interval, x0, None, length=windows.horizon)[1]

    def loss(field):
        errors = jax.vmap(partial(forecast, field))(windows.x0) - windows.x
        return jnp.mean(jnp.sum(jnp.square(errors), axis=-1))

    value, gradient = jax.value_and_grad(loss, allow_int=True)(field)
    direction, adam = optax.scale_by_adam().update(gradient, adam)
    return jax.tree.map(lambda p, d: p - RATE * d, field, direction), adam, value


def subject(kernel: int, preset: Preset) -> tuple[Any, Any, Any, hj.Trajectories, hj.Settings]:
    """A field, the state of Adam, the plan of a run, one window, and settings: the arguments of a gradient step."""
    field: Any = hybrid(kernel, preset)
    grid = field.physics.grid
    x0 = np.random.default_rng(0).random((1, grid.size)).astype(np.float32)
    u = np.zeros((1, preset.intervals, 0), np.float32)
    x = np.asarray(hj.rollout_batch(hybrid(1, preset), x0, u, DT, hj.RK4(substeps=SUBSTEPS))) * np.float32(0.9)
    windows, settings = hj.Trajectories(x0, u, x, DT), hj.Settings(batch_size=1, solver=hj.RK4(substeps=SUBSTEPS))
    plan = make_run_config(RATE, np.arange(1), 1, 1, 1, 1, 0.0)
    return field, start(field, jax.random.key(0)).adam, plan, windows, settings


def measured(kernel: int, preset: Preset) -> dict[str, Any]:
    field, adam, plan, windows, settings = subject(kernel, preset)
    step = partial(gradient_step, settings=settings)
    ours, _, our_memory = compiled_with_memory(step, field, adam, plan, windows)
    plain, _, memory = compiled_with_memory(plain_step, field, adam, windows)
    own, theirs = ((result[2], result[1].mu) for result in (ours(), plain()))
    assert all(jax.tree.leaves(trainable(field)))
    difference = agree(f"steps of kernel {kernel}", own, theirs, AGREEMENT)
    times = in_turns({"ours": ours, "plain": plain}, preset.turns)
    seconds = {name: times.median(name) for name in ("ours", "plain")}
    sizes = {"bytes": our_memory, "plain_bytes": memory}
    ratio = {"plain_over_ours": times.ratio("plain", "ours")}
    return {"kernel": kernel, "difference": difference, "seconds": seconds} | sizes | ratio


def jacobian(kernel: int, preset: Preset) -> dict[str, Any]:
    """The states of one interval and their derivatives along all parameters, as `fit_gauss_newton` needs them."""
    field: Any = hybrid(kernel, preset)
    solver = hj.RK4(substeps=SUBSTEPS)
    x0 = np.random.default_rng(0).random(field.physics.grid.size).astype(np.float32)
    theta, at = ravel_learned(field)

    def together(theta, x0):
        return with_sensitivities(at(theta), x0, jnp.zeros((1, 0)), DT, solver)

    def one_by_one(theta, x0):
        states, push = jax.linearize(lambda theta: hj.rollout(at(theta), x0, jnp.zeros((1, 0)), DT, solver), theta)
        return states, jnp.moveaxis(jax.lax.map(push, jnp.eye(theta.size)), 0, -1)

    calls = {way.__name__: compiled(way, theta, x0)[0] for way in (together, one_by_one)}
    own, theirs = (call() for call in calls.values())
    difference = agree(f"derivatives of kernel {kernel}", own, theirs, AGREEMENT)
    times = in_turns(calls, preset.turns)
    row = {"kernel": kernel, "parameters": theta.size, "seconds": {name: times.median(name) for name in calls}}
    return row | {"difference": difference, "ratio": times.ratio("one_by_one", "together")}


COLUMNS = {
    "kernel": lambda row: str(row["kernel"]),
    "ms": lambda row: f"{1e3 * row['seconds']['ours']:.1f}",
    "plain [ms]": lambda row: f"{1e3 * row['seconds']['plain']:.1f}",
    "plain / ours": lambda row: f"{row['plain_over_ours']:.2f}",
    "MB": lambda row: f"{row['bytes'] / 1e6:.1f}",
    "plain [MB]": lambda row: f"{row['plain_bytes'] / 1e6:.1f}",
    "differ by": lambda row: f"{row['difference']:.0e}",
}
JACOBIAN_COLUMNS = {
    "kernel": lambda row: str(row["kernel"]),
    "parameters": lambda row: str(row["parameters"]),
    "ms": lambda row: f"{1e3 * row['seconds']['together']:.1f}",
    "one direction at a time [ms]": lambda row: f"{1e3 * row['seconds']['one_by_one']:.1f}",
    "ratio": lambda row: f"{row['ratio']:.2f}",
    "differ by": lambda row: f"{row['difference']:.0e}",
}


def measure(preset: Preset) -> Findings:
    """A pointwise network and a convolution, against their plain selves."""
    rows = [measured(kernel, preset) for kernel in preset.kernels]
    ratios = [Ratio(f"kernel {row['kernel']}: plain / ours", row["plain_over_ours"], at_least=1 / 1.05) for row in rows]
    slopes = [jacobian(kernel, preset) for kernel in preset.kernels]
    ratios += [
        Ratio(f"kernel {row['kernel']}: one direction at a time / ours", row["ratio"], at_least=1) for row in slopes
    ]
    tables = [table("one gradient step of a field on a grid", rows, COLUMNS)]
    tables += [table("derivatives of one interval along all parameters", slopes, JACOBIAN_COLUMNS)]
    return Findings([*rows, *slopes], tables, ratios)


if __name__ == "__main__":
    run("grids", __doc__, PRESETS, measure)
