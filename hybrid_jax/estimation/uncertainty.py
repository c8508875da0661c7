"""Covariance and intervals of θ_p from its normal equations, and the choice of a constant disturbance."""

from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Array, Bool, Float, Int

from hybrid_jax import checks
from hybrid_jax.dynamics import AbstractVectorField, Hybrid, trainable
from hybrid_jax.dynamics.disturbance import disturbance_of, disturbance_units, physics_of, sized, with_disturbance
from hybrid_jax.estimation import least_squares
from hybrid_jax.estimation.least_squares import LeastSquaresFit, Scale, Solver, fit_free, ravel_parameters
from hybrid_jax.estimation.normal_equations import (
    CHUNK,
    NormalEquations,
    has_effect,
    inverse,
    inverses,
    left_out,
    masked,
    normal_equations,
)
from hybrid_jax.runtime import UNOPTIMISED, entry, jit_by_size
from hybrid_jax.trajectories import Trajectories

# Times machine epsilon. Rounding errors of many windows cancel, so this is less than for a step: the yaw of a small
# quadrotor, for example, distinguishes its rotors by 100 times the rounding.
EPSILONS = 8


class Interval(NamedTuple):
    """An estimate and its confidence interval, in one unit.

    Attributes:
        value: the estimate, one number or one for each of several runs.
        low: the lower end of the interval, with the same shape.
        high: the upper end, with the same shape.
    """

    value: Float[Array | np.ndarray, "*runs"]
    low: Float[Array | np.ndarray, "*runs"]
    high: Float[Array | np.ndarray, "*runs"]


@entry
def covariance_of(
    field: AbstractVectorField,
    windows: Trajectories,
    *,
    solver: Solver = None,
    chunk: int = CHUNK,
    scale: Scale = None,
    free: Bool[Array | np.ndarray, " p"] | None = None,
    cluster: int = 1,
) -> Float[Array, "p p"]:
    """Return the covariance of θ_p of a field that was fitted to windows, in the physics' own parametrisation.

    Rows are in the order of `ravel_parameters`, for example log Ix, log Iy, log k of a `RigidBody`. A parameter that is
    not identifiable has an infinite variance. You can use it under `jit` and `vmap`. Note that the covariance takes the
    network as exact and does not include bias: intervals are too narrow if a network was trained on the same windows,
    or if the model lacks an effect such as drag.

    It is the sandwich H⁻¹ M H⁻¹ with H = Σ_i J_iᵀJ_i and M = n/(n − p) Σ_i (J_iᵀr_i)(J_iᵀr_i)ᵀ: only windows must be
    independent; errors within one may be correlated and of any unit (Huber 1967; White 1980; the factor is MacKinnon
    and White's HC1, 1985).

    Args:
        field: at, or near, the minimum over θ_p of Σ_i ‖r_i‖² over windows i, with r_i = x − x̂ and J_i = ∂x̂/∂θ_p.
        windows: the windows that the field was fitted to.
        solver: integrates the field over each sample interval, by default one step of RK4.
        chunk: number of windows in memory at a time.
        scale: divides the error of each state, as in `fit_least_squares`.
        free: which parameters were fitted, all by default; the others are known and have no variance.
        cluster: number of consecutive windows that may be correlated, for example in one flight. The sandwich is then
            the jackknife over clusters (CV3 of MacKinnon, Nielsen and Webb, J. Applied Econometrics 2023), as the
            sandwich of summed J_iᵀr_i is too narrow for few clusters, and intervals need Student's t.

    Raises:
        ValueError: if there are no more windows than parameters, or they are malformed.
    """
    windows = least_squares.check_windows(field, windows, missing=True)
    fitted = ravel_parameters(field)[0].size if free is None else jnp.sum(free)
    if not checks.is_traced(fitted):
        check_determined(field, len(windows), int(fitted))
    checks.count("chunk", chunk)
    checks.count("cluster", cluster)
    equations = normal_equations(field, windows, solver, chunk, scale)
    seen = has_effect(equations, windows, scale)
    equations = masked(equations, seen if free is None else free & seen)
    unknown = ~seen if free is None else free & ~seen
    return _covariance(equations, fitted, cluster, len(windows)) + jnp.diag(jnp.where(unknown, jnp.inf, 0.0))


@jit_by_size(UNOPTIMISED)
def _covariance(equations: NormalEquations, p: Int[Array, ""] | int, cluster: int, n: Int[Array, ""] | int):
    gram, score, _ = equations
    bread = inverse(jnp.sum(gram, axis=0), EPSILONS)
    identified = bread.identified
    if cluster > 1:
        clusters, of = -(-len(score) // cluster), np.arange(len(score)) // cluster
        gram, score = (jax.ops.segment_sum(part, of, clusters) for part in (gram, score))
        without = inverses(jnp.sum(gram, axis=0) - gram, EPSILONS)
        identified = identified & without.identified.all(axis=0)
        # Changes of θ_p without each cluster.
        moves = jnp.einsum("gpq,gq->gp", without.matrix, score - jnp.mean(score, axis=0))
        moves = moves - jnp.mean(moves, axis=0)
        found = (clusters - 1) / clusters * moves.T @ moves
    else:
        half = score @ bread.matrix  # H⁻¹ M H⁻¹ as a product of itself: symmetric and never negative
        found = n / jnp.maximum(n - p, 1) * half.T @ half
    return found + jnp.diag(jnp.where(identified, 0.0, jnp.inf))


def sandwich(equations: NormalEquations, fitted: int, cluster: int = 1) -> Float[Array, "p p"]:
    """Compute H⁻¹ M H⁻¹ of `covariance_of` from equations in which all but `fitted` parameters are `masked`."""
    return _covariance(equations, fitted, cluster, len(equations.score))


def sandwich_with_prior(
    equations: NormalEquations, fitted: int, distinct: Int[Array, ""], precision: Float[Array, " p"]
) -> tuple[Float[Array, "p p"], Float[Array, " p"]]:
    """Compute `sandwich` with a prior, if only the first `distinct` windows are independent and the others repeat them.

    The precision is over the variance of an error. It holds directions that the windows hardly determine. Also return
    the step to the least error.
    """
    of = jnp.arange(len(equations.score)) % distinct
    score = jax.ops.segment_sum(equations.score, of, len(equations.score))
    half = score @ inverse(jnp.sum(equations.gram, axis=0) + jnp.diag(precision)).matrix
    return distinct / jnp.maximum(distinct - fitted, 1) * half.T @ half, -jnp.sum(half, axis=0)


@entry
def intervals(
    field: AbstractVectorField,
    covariance: Float[Array, "p p"],
    level: float = 0.95,
    degrees: float | Float[np.ndarray, " p"] | None = None,
) -> dict[str, Interval]:
    """Return the physical parameters of a field with confidence intervals; names are as in `named_parameters`.

    The error is normal in the physics' own parametrisation: the interval is value · exp(±z s) for a parameter that is
    stored as a logarithm and returned by `theta()`, otherwise value ± z s.

    Args:
        field: the fitted field. A disturbance in its physics is one of the parameters.
        covariance: covariance in the physics' own parametrisation (p, p), for example from `covariance_of`.
        level: confidence level, between 0 and 1.
        degrees: degrees of freedom of the covariance, or of each variance, for Student's t: for example one less than
            its clusters, or see `pooling.satterthwaite`; by default the normal distribution is used.

    Raises:
        ValueError: if level is not between 0 and 1, or the covariance has another shape or a negative variance.
    """
    check_level(level)
    p = jax.eval_shape(lambda: ravel_parameters(field)[0]).size
    array = checks.real_array("covariance", covariance)
    if array.shape != (p, p):
        raise ValueError(f"covariance must be ({p}, {p}), as the field has {p} parameters, got shape {array.shape}")
    if not checks.is_traced(array) and not ((variances := np.diagonal(array)) >= 0).all():
        raise ValueError(f"covariance must have variances of at least 0, got {variances}")
    upper = (1 + level) / 2
    quantile = scipy.special.ndtri(upper) if degrees is None else scipy.special.stdtrit(degrees, upper)
    return dict(zip(names_of(field), _bounds(physics_of(field), jnp.asarray(array), quantile), strict=True))


@jit_by_size(UNOPTIMISED)  # one by one, these small operations take a second to compile
def _bounds(physics: AbstractVectorField, covariance: Float[Array, "p p"], quantile) -> list[Interval]:
    theta, unravel = ravel_parameters(physics)
    away = (quantile * jnp.sqrt(jnp.diagonal(covariance).astype(float))).astype(theta.dtype)
    left, middle, right = (named_parameters(unravel(end)).values() for end in (theta - away, theta, theta + away))
    ends = zip(middle, left, right, strict=True)
    return [Interval(value, jnp.minimum(one, other), jnp.maximum(one, other)) for value, one, other in ends]


def check_determined(field: AbstractVectorField, n: int, fitted: int | None = None) -> None:
    """Raise if n windows are too few for the parameters to fit, by default all of the physics, or if there are none."""
    size, name = jax.eval_shape(lambda: ravel_parameters(field)[0]).size, type(physics_of(field)).__name__
    p = size if fitted is None else fitted
    if n <= p:
        raise ValueError(f"windows: {n} are too few for the {p} parameters of {name}, at least {p + 1} are needed")


def check_level(level: float) -> None:
    if not 0 < (checks.real(level) or 0) < 1:
        raise ValueError(f"level must be between 0 and 1, got {checks.short_repr(level)}")


def names_of(field: AbstractVectorField) -> list[str]:
    """Return the names of `named_parameters` in the order of compiled programs, in which dictionaries are sorted."""
    names: list[str] = []
    eqx.filter_eval_shape(lambda field: names.extend(named_parameters(field)), field)  # computes nothing
    return names


def named_parameters(field: AbstractVectorField) -> dict[str, Float[Array, ""]]:
    """Return the parameters of a field's physics, number by number.

    If the class has a method `theta() -> dict[str, Array]`, such as `RigidBody`, it gives names and values in physical
    units; each entry must be a monotonic function of one parameter. Otherwise the names are the class's fields.
    Entries of arrays are, for example, k_rotors[0] and aerodynamic_moment[0,2]. A constant disturbance uses the names
    of states, or indices: disturbance[vx], disturbance[0].
    """
    physics, disturbance = physics_of(field), disturbance_of(field)
    if isinstance(physics, Hybrid) and disturbance is not None:
        names, values = disturbance_units(physics), jnp.atleast_1d(disturbance.value)
        return named_parameters(physics.physics) | dict(zip(names, values, strict=True))
    leaves = jax.tree_util.tree_leaves_with_path(eqx.filter(physics, trainable(physics)))
    values = {jax.tree_util.keystr(path, simple=True, separator="."): leaf for path, leaf in leaves}
    if (theta := getattr(type(physics), "theta", None)) is not None:
        values = theta(physics)
    return {
        f"{name}[{','.join(map(str, at))}]" if at else name: value[at]
        for name, value in values.items()
        for at in np.ndindex(value.shape)
    }


class DisturbanceSelection(eqx.Module):
    """The better of two fits, with and without a disturbance.

    Attributes:
        fit: the better of the two fits, with a disturbance of zero if none is needed.
        needed: whether a disturbance lowers the mean L_MSE of left-out windows by more than its standard error.
    """

    fit: LeastSquaresFit
    needed: Bool[Array, ""]


@entry
def select_disturbance(
    field: AbstractVectorField,
    windows: Trajectories,
    *,
    solver: Solver = None,
    max_steps: int = 100,
    scale: Scale = None,
    indices: tuple[int, ...] | None = None,
) -> DisturbanceSelection:
    """Fit θ_p with and without a constant disturbance and choose by leave-one-out cross-validation (Stone 1974).

    The simpler model is chosen unless it is worse by more than one standard error of the difference (Breiman, Friedman,
    Olshen and Stone, Classification and Regression Trees, 1984, Sec. 3.4.3), or if windows do not identify θ_p. It
    raises the errors of `fit_least_squares`.

    Args:
        field: the initial field, with or without a disturbance.
        windows: windows of the system, independent of each other.
        solver: the integrator over each interval, by default one step of RK4.
        max_steps: the maximum number of steps of each fit.
        scale: the error of each state that counts as 1 (d,), in its own unit; by default 1 for each.
        indices: the disturbed states, see `with_disturbance`.
    """
    larger = sized(with_disturbance(field, indices), windows.x0.shape[-1])
    parameters, _ = ravel_parameters(larger)
    own = parameters.size - disturbance_of(larger).value.size  # pyright: ignore[reportOptionalMemberAccess]
    none = eqx.tree_at(disturbance_of, larger, replace_fn=partial(jax.tree.map, jnp.zeros_like))
    # Both are fits of the larger field, so that one program serves them.
    windows = least_squares.check_windows(field, windows, missing=True)
    checks.count("max_steps", max_steps)
    every = np.ones(parameters.size, bool), np.arange(parameters.size) < own
    options = windows, solver, max_steps, scale
    fits = [fit_free(start, *options, jnp.asarray(free)) for start, free in zip((larger, none), every, strict=True)]
    equations = [normal_equations(fit.field, windows, solver, CHUNK, scale) for fit in fits]
    equations[1] = masked(equations[1], every[1])
    return _selection(fits, equations, windows.horizon)


@jit_by_size()
def _selection(fits: list[LeastSquaresFit], equations: list[NormalEquations], horizon: int) -> DisturbanceSelection:
    disturbed, plain = fits
    gains = left_out(equations[1], horizon) - left_out(equations[0], horizon)
    needed = jnp.mean(gains) > jnp.std(gains, ddof=1) / jnp.sqrt(len(gains))  # False where one of them is not finite
    kept = jax.tree.map(lambda a, b: jnp.where(needed, a, b) if eqx.is_array(a) else a, disturbed, plain)
    return DisturbanceSelection(kept, needed)
