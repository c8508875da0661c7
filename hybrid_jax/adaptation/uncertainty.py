"""How well flight pins down θ_p: a covariance of the physics' parameters from the Gauss–Newton matrix of L_MSE.

θ̂_p minimises Σ_i ‖r_i‖² over windows i, r_i = x − x̂ and J_i = ∂x̂/∂θ_p of one window, all its states in one vector. With
H = Σ_i J_iᵀJ_i (Björck, Numerical Methods for Least Squares Problems, 1996, Sec. 9.2) the covariance of θ̂_p is

- sandwich: H⁻¹ M H⁻¹ with M = n/(n − p) Σ_i (J_iᵀr_i)(J_iᵀr_i)ᵀ. Windows are the clusters: only they must be
  independent, while the errors within a window may be correlated and of any size and unit (Huber 1967; White 1980; for
  clusters Liang and Zeger 1986; the factor is MacKinnon and White's HC1, 1985).
- homoscedastic: σ² H⁻¹, right only if every entry of every r_i is white noise of one variance.

A loss that counts errors otherwise, such as channels.py's, takes its slope and curvature at each error into M and H:
M-estimation, of which the sandwich holds as it stands (Huber 1967).

**Both are conditional on θ_d**: the network of a hybrid is taken as given, as if it had not been learned from the same
windows, so they are too small by what θ_d may trade with θ_p. Neither contains bias: what the model cannot express
(drag that it does not know) moves θ̂_p by an amount that no interval shows; `experiments/coverage.py` measures both.
"""

from collections.abc import Callable
from typing import Literal, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hybrid_jax import checks
from hybrid_jax.adaptation.least_squares import check_windows, parametrise, physics_of, residual
from hybrid_jax.dynamics.base import AbstractVectorField
from hybrid_jax.dynamics.rigid_body import AbstractRigidBody
from hybrid_jax.trajectories import Trajectories

Kind = Literal["sandwich", "homoscedastic"]
Counted = Callable[[Float[Array, " d"]], Float[Array, ""]]


class Interval(NamedTuple):
    """An estimate and the interval around it, in the same unit."""

    value: Float[Array, "*lanes"]
    low: Float[Array, "*lanes"]
    high: Float[Array, "*lanes"]


def covariance_of(
    field: AbstractVectorField,
    windows: Trajectories,
    kind: Kind = "sandwich",
    solver: diffrax.AbstractSolver | None = None,
    chunk: int = 250,
    error: Counted | None = None,
) -> Float[Array, "p p"]:
    """The covariance of θ_p at a field fitted to the windows, given θ_d, in the physics' own parametrisation.

    Rows are in the order of `least_squares.parametrise`; for a `RigidBody`: log Ix, log Iy, log k. Pure, so it compiles
    and maps over stacked fields. It is not finite where the windows do not tell the parameters apart.

    Args:
        field: at, or near, the minimum over θ_p of L_MSE, or of what `error` makes of it.
        chunk: windows that are held in memory at a time.
        error: what an error x − x̂ (d,) counts in the loss that was minimised, such as `ChannelPrediction.error`; its
            square by default.

    Raises:
        ValueError: no more windows than parameters, an unknown kind, another error than the square where all are to be
            white, or windows that are malformed.
    """
    check_windows(field, windows)
    checks.count("chunk", chunk)
    n, p = len(windows), parametrise(field)[0].size
    if n <= p:
        raise ValueError(f"windows: {n} are too few for a covariance of {p} parameters, at least {p + 1} are needed")
    if kind not in Kind.__args__:
        raise ValueError(f"kind must be one of {', '.join(Kind.__args__)}, got {kind!r}")
    if error is not None and kind == "homoscedastic":
        raise ValueError("kind must be sandwich where an error is given: homoscedastic is that of squared errors")
    return _covariance_of(field, windows, kind, solver, chunk, error)


@eqx.filter_jit
def _covariance_of(
    field, windows: Trajectories, kind: Kind, solver, chunk: int, error: Counted | None
) -> Float[Array, "p p"]:
    gram, score, square = normal_equations(field, windows, solver, chunk, error)
    n, p = score.shape
    bread = inverse(jnp.sum(gram, axis=0))
    if kind == "homoscedastic":
        return jnp.sum(square) / (n * windows.x[0].size - p) * bread
    half = score @ bread  # H⁻¹ M H⁻¹ as a product of itself: symmetric and never negative
    return n / (n - p) * half.T @ half


class NormalEquations(NamedTuple):
    """What each window adds to those of θ_p, J that of its residual r.

    Attributes:
        gram: JᵀJ.
        score: Jᵀr.
        square: rᵀr.
    """

    gram: Float[Array, "n p p"]
    score: Float[Array, "n p"]
    square: Float[Array, " n"]


def normal_equations(
    field: AbstractVectorField,
    windows: Trajectories,
    solver: diffrax.AbstractSolver | None = None,
    chunk: int = 250,
    error: Counted | None = None,
) -> NormalEquations:
    """Those of each window at a field's θ_p, with the slope and curvature of what an error counts, if not its square.

    Args:
        chunk: windows that are held in memory at a time.
    """
    theta, rebuild = parametrise(field)

    def one(window: Trajectories) -> NormalEquations:
        def missed(theta):
            r = residual(rebuild(theta), window, solver)
            return r, r

        jacobian, r = jax.jacfwd(missed, has_aux=True)(theta)
        bent, slope = (jacobian, r) if error is None else _counted(error, jacobian, r)
        effect, r = jacobian.reshape(-1, theta.size), r.ravel()
        return NormalEquations(effect.T @ bent.reshape(-1, theta.size), effect.T @ slope.ravel(), r @ r)

    return jax.lax.map(one, windows, batch_size=min(chunk, len(windows)))


def _counted(
    error: Counted, jacobian: Float[Array, "t d p"], r: Float[Array, "t d"]
) -> tuple[Float[Array, "t d p"], Float[Array, "t d"]]:
    """(C J, slope) with slope and curvature C of what each error counts: J and r themselves, doubled, of the square."""
    curvature = jax.vmap(jax.hessian(error))(r)
    return jnp.einsum("tde,tep->tdp", curvature, jacobian), jax.vmap(jax.grad(error))(r)


def standard_errors(field: AbstractVectorField, covariance: Float[Array, "p p"]) -> AbstractVectorField:
    """A tree like the physics with the standard error of each parameter in its place.

    Raises:
        ValueError: a covariance of another number of parameters, or one that is known and is not finite, as where the
            windows do not tell the parameters apart, or has a negative variance.
    """
    theta, rebuild = parametrise(physics_of(field))
    return rebuild(_deviations(covariance, theta.size))


def intervals(field: AbstractVectorField, covariance: Float[Array, "p p"], level: float = 0.95) -> dict[str, Interval]:
    """θ_p of a field with named parameters in SI units, as its `theta`, each with an interval.

    By entry: k_rotors[0] … k_rotors[3], aerodynamic_moment[0,0] …. The error is taken as normal where the parameter is
    held, so the interval is value · exp(±z s) of what is held as a logarithm and value ± z s of the rest.

    Raises:
        ValueError: a level that is not between 0 and 1, or physics that is neither `RigidBody` nor `Multirotor` nor
            another `AbstractRigidBody`; as `standard_errors`.
    """
    if not 0 < (checks.real(level) or 0) < 1:
        raise ValueError(f"level must be between 0 and 1, got {checks.short_repr(level)}")
    physics = physics_of(field)
    if not isinstance(physics, AbstractRigidBody):
        name = type(physics).__name__
        raise ValueError(f"field: its physics must be a RigidBody or Multirotor, got {name}; see standard_errors")
    theta, rebuild = parametrise(physics)
    away = jax.scipy.special.ndtri((1 + level) / 2) * _deviations(covariance, theta.size)
    values = _entries(physics)
    low, high = (_entries(rebuild(end)) for end in (theta - away, theta + away))
    return {name: Interval(value, low[name], high[name]) for name, value in values.items()}


def _entries(physics) -> dict[str, Float[Array, ""]]:
    """θ_p number by number."""

    def named(name: str, place: tuple[int, ...]) -> str:
        return f"{name}[{','.join(map(str, place))}]" if place else name

    theta = physics.theta()
    return {named(name, at): value[at] for name, value in theta.items() for at in np.ndindex(value.shape)}


def _deviations(covariance: Float[Array, "p p"], p: int) -> Float[Array, " p"]:
    variances = jnp.diagonal(_square(covariance, p))
    if not checks.is_traced(variances) and (variances < 0).any():
        raise ValueError(f"covariance must have variances of at least 0, got {variances}")
    return jnp.sqrt(variances)


def _square(covariance: Float[Array, "p p"], p: int) -> Float[Array, "p p"]:
    array = checks.real_array("covariance", covariance)
    if array.shape != (p, p):
        raise ValueError(f"covariance must be ({p}, {p}), as the field has {p} parameters, got shape {array.shape}")
    return checks.floating("covariance", array)


def inverse(matrix: Float[Array, "p p"]) -> Float[Array, "p p"]:
    """Of a positive definite matrix, scaled to a unit diagonal first: parameters may be of very different effect."""
    scale = jnp.sqrt(jnp.diagonal(matrix))
    scales = scale[:, None] * scale
    return jnp.linalg.inv(matrix / scales) / scales
