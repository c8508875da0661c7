"""Adaptation in closed form: regress defects on hidden units or on x and u (O'Connell et al. 2022, Neural-Fly).

An interval at one of whose ends a state was not measured (NaN) does not count.
"""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from hybrid_jax import checks
from hybrid_jax.dynamics.base import AbstractVectorField, state_space
from hybrid_jax.dynamics.composition import Hybrid
from hybrid_jax.estimation.least_squares import Solver
from hybrid_jax.integrate import checked, integrate
from hybrid_jax.networks.mlp import LinearResidual, ResidualNetwork
from hybrid_jax.training.objective import Settings
from hybrid_jax.trajectories import Trajectories, check

PENALTIES = tuple(10.0**power for power in range(6, -5, -1))  # the strongest, which changes least, first

Penalty = Float[Array, ""] | float
Update = Callable[[AbstractVectorField, Trajectories, Penalty, Solver], AbstractVectorField]  # such as `last_layer`


class RidgeFit(NamedTuple):
    """The result of `fit_ridge`."""

    field: AbstractVectorField  # at the chosen penalty
    penalty: Float[Array, ""]  # the chosen penalty, which should not be an end of the grid
    mse: Float[Array, ""]  # the validation loss at this penalty


def last_layer(
    field: AbstractVectorField, windows: Trajectories, penalty: Penalty, solver: Solver = None
) -> AbstractVectorField:
    """Change the output layer of a `ResidualNetwork`, or of a `Hybrid` whose residual is one, by ΔW, Δb.

    They minimise Σ ‖e − (ΔW φ̄ + Δb)‖² + penalty ‖(ΔW, Δb)‖² over all intervals, with e the field's defect and φ̄ the
    mean of the hidden units, in inference mode, at the two ends of the interval.

    Raises:
        ValueError: another field, malformed windows, or a penalty that is not positive.
    """
    network = field.residual if isinstance(field, Hybrid) else field
    if not isinstance(network, ResidualNetwork):
        raise ValueError(f"last_layer needs a field whose residual is a ResidualNetwork, got {type(network).__name__}")
    (before, u, after, known), canonical = transitions(windows), jax.vmap(state_space(field).canonical)
    activations = jax.vmap(network.activations)
    middle = (activations(canonical(before, before), u) + activations(canonical(after, after), u)) / 2
    scale = network.scaling.outputs(jnp.ones_like(network.bias_out))
    weight, bias = ridge(middle, canonical(before, defects(field, windows, solver)) / scale, penalty, known)
    output = (network.weight_out + weight, network.bias_out + bias)
    changed = eqx.tree_at(lambda network: (network.weight_out, network.bias_out), network, output)
    return Hybrid(field.physics, changed) if isinstance(field, Hybrid) else changed


def linear_residual(
    field: AbstractVectorField, windows: Trajectories, penalty: Penalty, solver: Solver = None
) -> Hybrid:
    """Add a linear map of the standardised [x, u], regressed on the defects; raises like `last_layer`."""
    (before, u, after, known), canonical = transitions(windows), jax.vmap(state_space(field).canonical)
    z = jnp.concatenate([canonical(before, (before + after) / 2), u], axis=1)
    mean, scale = mean_and_scale(z, known)
    weight, bias = ridge((z - mean) / scale, canonical(before, defects(field, windows, solver)), penalty, known)
    return Hybrid(field, LinearResidual(weight / scale, bias - weight @ (mean / scale)))


def fit_ridge(
    update: Update,
    field: AbstractVectorField,
    train: Trajectories,
    validation: Trajectories,
    penalties: tuple[float, ...] = PENALTIES,
    settings: Settings | None = None,
) -> RidgeFit:
    """Update a field with the penalty of smallest validation loss. You can use this under `jit` and `vmap`."""
    check(train, "train", missing=True)
    check(validation, "validation", missing=True)
    if not penalties:
        raise ValueError("penalties must contain at least one positive number, got none")
    for penalty in penalties:
        checks.positive("penalties", penalty, "positive finite numbers")
    settings, grid = Settings() if settings is None else settings, jnp.asarray(penalties, float)
    # The decomposition inside `ridge` does not depend on the penalty, so vmap computes it once for the whole grid.
    candidates = eqx.filter_vmap(lambda penalty: update(field, train, penalty, settings.solver))(grid)
    arrays, rest = eqx.partition(candidates, eqx.is_array)
    losses = jax.lax.map(lambda one: settings.objective.validate(eqx.combine(one, rest), validation, settings), arrays)
    best = jnp.argmin(jnp.where(jnp.isfinite(losses), losses, jnp.inf))  # one that diverges is not chosen
    return RidgeFit(eqx.combine(jax.tree.map(lambda leaf: leaf[best], arrays), rest), grid[best], losses[best])


def transitions(
    windows: Trajectories,
) -> tuple[Float[Array, "s d"], Float[Array, "s m"], Float[Array, "s d"], Bool[Array, " s"]]:
    """Return the state before, the input and the state after each interval, and whether both states were measured.

    In place of states that were not, you get those at the start of the window. The windows are checked.
    """
    check(windows, "windows", missing=True)
    x0, u, x = (jnp.asarray(a) for a in (windows.x0, windows.u, windows.x))
    (n, steps, d), start = x.shape, jnp.broadcast_to(x0[:, None], x.shape)
    before = jnp.concatenate([x0[:, None], x[:, :-1]], axis=1)
    known = ~jnp.isnan(before + x).any(axis=-1)
    if not checks.is_traced(known) and not known.any():
        raise ValueError("windows: no interval has all states measured at both ends")
    before, after = (jnp.where(known[..., None], each, start).reshape(n * steps, d) for each in (before, x))
    return before, u.reshape(n * steps, u.shape[2]), after, known.ravel()


def defects(field: AbstractVectorField, windows: Trajectories, solver: Solver = None) -> Float[Array, "s d"]:
    """Return the derivative e that the field lacks in each interval, the mean of both ends, to second order in dt.

    With Φ one solver step, (x₁ − Φ(x₀)) / dt is off by ½ dt ∂f/∂x e; the step backwards from x₁ is off by the opposite.
    Where a state was not measured, e is NaN.
    """
    (before, u, after, known), dt = transitions(windows), windows.dt
    before, u, solver = checked(field, before, u[:, None], dt, solver, windows=True)
    after = after.astype(before.dtype)

    def step(start: Float[Array, "s d"], dt: float) -> Float[Array, "s d"]:
        return jax.vmap(lambda x, held: integrate(field, x, held, dt, solver))(start, u)[:, 0]

    found = ((after - step(before, dt)) + (step(after, -dt) - before)) / (2 * dt)
    return jnp.where(known[:, None], found, jnp.nan)


def mean_and_scale(
    z: Float[Array, "s n"], known: Bool[Array, " s"] | None = None
) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
    """Return each channel's mean and scale: its standard deviation, or 1e-3 of its mean if that is more, or 1.

    Only rows that are known count, by default all.
    """
    where = None if known is None else known[:, None]
    mean, spread = jnp.mean(z, axis=0, where=where), jnp.std(z, axis=0, where=where)
    floor = 1e-3 * jnp.abs(mean)  # the spread of a constant channel is round-off, which must not become a feature
    return mean, jnp.where(spread + floor > 0, jnp.maximum(spread, floor), 1.0)


def ridge(
    z: Float[Array, "s n"], y: Float[Array, "s d"], penalty: Penalty, known: Bool[Array, " s"] | None = None
) -> tuple[Float[Array, "d n"], Float[Array, " d"]]:
    """Minimise Σ ‖y − (W z + b)‖² + penalty ‖(W, b)‖² over W, b, by the rows that are known, by default all."""
    checks.positive("penalty", penalty)
    # The normal equations would square the design's condition number, about 1e4 for hidden units, beyond float32.
    design = jnp.concatenate([z, jnp.ones((len(z), 1), z.dtype)], axis=1)
    if known is not None:
        design, y = (jnp.where(known[:, None], each, 0.0) for each in (design, y))
    with jax.default_matmul_precision("highest"):  # a GPU's default rounds factors to 10 bits
        left, sizes, right = jnp.linalg.svd(design, full_matrices=False)
        solution = right.T @ ((sizes / (jnp.square(sizes) + penalty))[:, None] * (left.T @ y))
    return solution[:-1].T, solution[-1]
