"""Adaptation in closed form: a linear correction of a pre-trained field by ridge regression, without a rollout trained.

What a field misses shows in each recorded interval as a defect, the mean derivative that it lacks; regressed on
features of the state it gives a correction at once. `last_layer` takes the features that the network learned in the
source (O'Connell et al. 2022, Neural-Fly, where an adaptive law does it in flight); `linear_residual` takes state and
input as they are.
"""

from collections.abc import Callable

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from hybrid_jax import checks
from hybrid_jax.dynamics.base import AbstractVectorField, Hybrid
from hybrid_jax.integrate import checked, integrate
from hybrid_jax.metrics import rollout_mse
from hybrid_jax.networks.mlp import LinearResidual, ResidualNetwork
from hybrid_jax.trajectories import Trajectories, check

PENALTIES = tuple(10.0**power for power in range(6, -5, -1))  # the most cautious first

Penalty = Float[Array, ""] | float
Method = Callable[[AbstractVectorField, Trajectories, Penalty], AbstractVectorField]


class Intervals(eqx.Module):
    """Recorded intervals of length dt [s]: the states at both ends and the input held between, whatever the window."""

    before: Float[Array, "s d"]
    after: Float[Array, "s d"]
    u: Float[Array, "s m"]
    dt: float = eqx.field(static=True)


class Adapted(eqx.Module):
    """What `adapted` chose.

    Attributes:
        field: the adapted field.
        penalty: the one chosen; at an end of the grid, the grid is too short.
        mse: its L_MSE on the validation windows.
    """

    field: AbstractVectorField
    penalty: Float[Array, ""]
    mse: Float[Array, ""]


def last_layer(
    field: AbstractVectorField,
    windows: Trajectories,
    penalty: Penalty,
    solver: diffrax.AbstractSolver | None = None,
) -> AbstractVectorField:
    """The field with the output layer of its network moved by ΔW, Δb, and all else as it was.

    They minimise Σ ‖e − (ΔW φ̄ + Δb)‖² + penalty ‖(ΔW, Δb)‖² over all intervals, with e the field's defect and φ̄ the
    mean of the hidden units, as deployed, at the two ends of the interval: ridge regression towards the source.

    Args:
        field: a `ResidualNetwork`, or a `Hybrid` whose residual is one.
        penalty: positive.

    Raises:
        ValueError: another field, windows that are malformed, or a penalty that is known and not positive.
    """
    network = field.residual if isinstance(field, Hybrid) else field
    if not isinstance(network, ResidualNetwork):
        raise ValueError(f"last_layer needs a field whose residual is a ResidualNetwork, got {type(network).__name__}")
    check(windows, "windows")
    checks.positive("penalty", penalty)
    intervals = intervals_of(windows)
    lacking = defects(field, intervals, solver)
    activations = jax.vmap(network.activations)
    middle = (activations(intervals.before, intervals.u) + activations(intervals.after, intervals.u)) / 2
    scale = network.scaling.outputs(jnp.ones_like(network.bias_out))
    weight, bias = ridge(middle, lacking / scale, penalty)
    output = (network.weight_out + weight, network.bias_out + bias)
    moved = eqx.tree_at(lambda network: (network.weight_out, network.bias_out), network, output)
    return Hybrid(field.physics, moved) if isinstance(field, Hybrid) else moved


def linear_residual(
    field: AbstractVectorField,
    windows: Trajectories,
    penalty: Penalty,
    solver: diffrax.AbstractSolver | None = None,
) -> Hybrid:
    """The field plus a linear map of [x, u], regressed on the defects as in `last_layer`.

    Args:
        penalty: positive; on the map of [x, u] less its mean over its standard deviation, so that units do not matter.

    Raises:
        ValueError: windows that are malformed, or a penalty that is known and not positive.
    """
    check(windows, "windows")
    checks.positive("penalty", penalty)
    intervals = intervals_of(windows)
    z = jnp.concatenate([(intervals.before + intervals.after) / 2, intervals.u], axis=1)
    mean, scale = standard(z)
    weight, bias = ridge((z - mean) / scale, defects(field, intervals, solver), penalty)
    return Hybrid(field, LinearResidual(weight / scale, bias - weight @ (mean / scale)))


def adapted(
    method: Method,
    field: AbstractVectorField,
    train: Trajectories,
    validation: Trajectories,
    penalties: tuple[float, ...] = PENALTIES,
    solver: diffrax.AbstractSolver | None = None,
) -> Adapted:
    """The method's field at the penalty that predicts the validation windows best.

    Pure: `jax.jit` compiles it, `jax.vmap` maps it over stacked fields and training windows.

    Raises:
        ValueError: windows that are malformed, or penalties that are not positive numbers.
    """
    check(train, "train")
    check(validation, "validation")
    if not penalties:
        raise ValueError("penalties must be some positive numbers, got none")
    for penalty in penalties:
        checks.positive("penalties", penalty, "positive finite numbers")
    grid = jnp.asarray(penalties, float)
    # The decomposition inside `ridge` does not depend on the penalty, so vmap computes it once for the whole grid.
    candidates = eqx.filter_vmap(lambda penalty: method(field, train, penalty))(grid)
    best, errors = select(candidates, validation, solver)
    arrays, rest = eqx.partition(candidates, eqx.is_array)
    chosen = eqx.combine(jax.tree.map(lambda leaf: leaf[best], arrays), rest)
    return Adapted(chosen, grid[best], errors[best])


def select(
    candidates: AbstractVectorField, windows: Trajectories, solver: diffrax.AbstractSolver | None = None
) -> tuple[Int[Array, ""], Float[Array, " c"]]:
    """Which of c stacked fields predicts the windows best, as deployed, and the L_MSE of each.

    One that diverges is never chosen; if all do, the first is.
    """
    arrays, rest = eqx.partition(candidates, eqx.is_array)
    errors = jax.lax.map(lambda one: rollout_mse(eqx.combine(one, rest), windows, solver=solver), arrays)
    return jnp.argmin(jnp.where(jnp.isfinite(errors), errors, jnp.inf)), errors


def intervals_of(windows: Trajectories) -> Intervals:
    """All intervals of all windows."""
    x0, u, x = (jnp.asarray(a) for a in (windows.x0, windows.u, windows.x))
    before = jnp.concatenate([x0[:, None], x[:, :-1]], axis=1)
    return Intervals(*(jnp.reshape(a, (x.shape[0] * x.shape[1], a.shape[2])) for a in (before, x, u)), dt=windows.dt)


def defects(
    field: AbstractVectorField, intervals: Intervals, solver: diffrax.AbstractSolver | None = None
) -> Float[Array, "s d"]:
    """e = the derivative that the field lacks, mean of the interval's two ends, to second order in dt.

    With Φ one solver step, (x₁ − Φ(x₀)) / dt is off by ½ dt ∂f/∂x e: an acceleration that is missing also moves the
    position, and would be corrected there a second time. The same step backwards from x₁ is off by as much to the other
    side, so the mean of the two is free of it. A field that is exact has no defect at all.
    """

    before, after, dt = intervals.before, intervals.after, intervals.dt
    before, u, solver = checked(field, before, intervals.u[:, None], dt, solver, windows=True)
    after = after.astype(before.dtype)

    def step(start: Float[Array, "s d"], dt: float) -> Float[Array, "s d"]:
        return jax.vmap(lambda x, held: integrate(field, x, held, dt, solver))(start, u)[:, 0]

    return ((after - step(before, dt)) + (step(after, -dt) - before)) / (2 * dt)


def standard(z: Float[Array, "s n"]) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
    """The mean and scale of each channel: its standard deviation, or 1e-3 of its mean if that is more, or 1."""
    mean, spread = jnp.mean(z, axis=0), jnp.std(z, axis=0)
    # What a channel that never varied has is round-off; divided by its own spread it would become a feature.
    floor = 1e-3 * jnp.abs(mean)
    return mean, jnp.where(spread + floor > 0, jnp.maximum(spread, floor), 1.0)


def ridge(
    z: Float[Array, "s n"], y: Float[Array, "s d"], penalty: Penalty
) -> tuple[Float[Array, "d n"], Float[Array, " d"]]:
    """W, b that minimise Σ ‖y − (W z + b)‖² + penalty ‖(W, b)‖², for a positive penalty.

    By the singular values of [z, 1]: the normal equations would square its condition number, about 1e4 for hidden
    units, and that is all that float32 has; and one decomposition serves every penalty.
    """
    design = jnp.concatenate([z, jnp.ones((len(z), 1), z.dtype)], axis=1)
    with jax.default_matmul_precision("highest"):  # a GPU's default rounds factors to 10 bits
        left, sizes, right = jnp.linalg.svd(design, full_matrices=False)
        shrunk = (sizes / (jnp.square(sizes) + penalty))[:, None] * (left.T @ y)
        solution = right.T @ shrunk
    return solution[:-1].T, solution[-1]
