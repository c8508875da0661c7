"""Steps of an extended Kalman filter of z = [x, a]: the state of a system, and numbers a that move its parameters.

Measurements are processed sequentially without a matrix inverse, and covariances are stored as square roots (Potter's
method; Bierman, "Factorization methods for discrete sequential estimation", 1977, ch. II). All functions are pure and
map over filters of one size.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from hybrid_jax.integrate import rk4_step
from hybrid_jax.online.samples import Sample
from hybrid_jax.online.tuning import BOUND, Tuning

Each = Callable[[Callable], Callable]  # maps a function over filters, like `jax.vmap`
Field = Callable[[Array, Array], Array]  # ẋ as a function of x and a
Scalar = Float[Array, ""]


class Belief(NamedTuple):
    """Mean of z and a square root of its covariance, which therefore stays positive semidefinite."""

    z: Float[Array, " n"]
    root: Float[Array, "n m"]  # after `triangular` the rows of a are zero after the first k columns

    @property
    def covariance(self) -> Float[Array, "n n"]:
        return self.root @ self.root.T


class FilterModel(NamedTuple):
    """The model and settings that all filters share in a period."""

    field: Field  # ẋ as a function of x and θ, under the input of the period
    unit: Callable[[Array], Array]  # normalises x, for example its quaternion; see `StateSpace.normalise`
    variances: Float[Array, " d"]  # of the measurements
    process_noise: Float[Array, " d"]  # variance of x per period
    dt: float  # length of a period [s]
    tuning: Tuning
    each: Each

    def project(self, belief: Belief) -> Belief:
        """Normalise the quaternion and clip a to its bounds."""
        z, d = belief.z, len(self.variances)
        return Belief(jnp.concatenate([self.unit(z[:d]), jnp.clip(z[d:], -BOUND, BOUND)]), belief.root)


class Correction(NamedTuple):
    """The correction of the filter by a sample."""

    errors: Float[Array, " d"]  # innovations over their standard deviations
    white: Float[Array, " d"]  # the same, clipped
    sizes: Float[Array, " d"]  # standard deviations of the innovations
    gains: Float[Array, "d n"]  # of z for the whitened innovations
    log_likelihood: Float[Array, ""]  # of the sample up to a constant


def step_with_jacobian(
    model: FilterModel, field: Field, x: Float[Array, " d"], a: Float[Array, " k"]
) -> tuple[Array, Array]:
    """Compute the next x by RK4 and its Jacobian in x and a, to O(dt³) from one Jacobian of ẋ at the midpoint."""
    moved = model.unit(rk4_step(field, x, a, model.dt))
    push = jax.linearize(field, (x + moved) / 2, a)[1]
    d, eye = len(x), jnp.eye(len(x) + len(a), dtype=x.dtype)
    rates = jax.vmap(push, out_axes=1)(eye[:, :d], eye[:, d:])
    slope = eye[:d] + model.dt * (rates + model.dt / 2 * rates[:, :d] @ rates)
    return moved, jax.vmap(jax.linearize(model.unit, moved)[1], 1, 1)(slope)


def predict(
    belief: Belief,
    model: FilterModel,
    field: Field,
    transition: Float[Array, "k k"] | None,
    diffusion: Float[Array, " k"],
    acted: Bool[Array, ""],
    part: Float[Array, "k k"] | None = None,
) -> tuple[Belief, Float[Array, "d n"]]:
    """Predict one period if a known input was applied; also return the Jacobian of the next x.

    `part` projects a on the directions that are estimated, by default all; `Tuning.caution` applies to these.
    """
    z, root = belief
    d = len(model.variances)
    moved, slope = step_with_jacobian(model, field, z[:d], z[d:])
    own, a = root[d:], z[d:]
    learned = own if part is None else part @ own
    # While a is uncertain, products of errors in a and x, which a linear filter neglects, move the state.
    noise = model.process_noise + model.tuning.caution**2 * jnp.sum(jnp.square(slope[:, d:] @ learned), axis=1)
    if transition is not None:
        own, a = transition @ own, transition @ a
    later = jnp.where(acted, jnp.concatenate([slope @ root, own]), root)
    later = jnp.concatenate([later, jnp.diag(jnp.sqrt(jnp.concatenate([noise, diffusion])))], axis=1)
    return Belief(jnp.where(acted, jnp.concatenate([moved, a]), z), later), slope


def reset_state(
    belief: Belief, sample: Sample, restart: Bool[Array, ""] | bool, variances: Float[Array, " d"]
) -> Belief:
    """Reset x to the sample if `restart`; keep a. The belief is triangular, or predicted from a triangular one."""
    z, root = belief
    d, k = len(variances), len(z) - len(variances)
    fresh = jnp.diag(jnp.sqrt(jnp.where(sample.seen, variances, 1e4 * variances)))
    fresh = jnp.pad(fresh, ((0, 0), (k, root.shape[1] - k - d)))
    z = jnp.concatenate([jnp.where(restart & sample.seen, sample.x, z[:d]), z[d:]])
    return Belief(z, jnp.concatenate([jnp.where(restart, fresh, root[:d]), root[d:]]))


def triangular(belief: Belief, d: int) -> Belief:
    """Make the root square, triangular for a first, by the modified Gram-Schmidt method."""
    n = len(belief.root)

    def column(rows, at):  # a unit vector instead of an index, which has no counterpart in C
        row = at[0] @ rows
        size = jnp.sqrt(jnp.sum(jnp.square(row)))
        unit = row / jnp.where(size > 0, size, 1.0)
        along = at[1] * (rows @ unit)
        return rows - along[:, None] * unit, along

    rows = jnp.concatenate([belief.root[d:], belief.root[:d]])
    eye = jnp.eye(n, dtype=rows.dtype)
    root = jax.lax.scan(column, rows, (eye, jnp.triu(jnp.ones_like(eye))))[1].T
    return Belief(belief.z, jnp.concatenate([root[n - d :], root[: n - d]]))


def measured(row: Float[Array, " m"], root: Float[Array, "n m"], noise: Scalar) -> tuple[Scalar, Array, Array]:
    """Return the variance of an innovation, the gain for it over its standard deviation, and the root after it.

    `row` is the measured row of the root, or a combination of rows, and `noise` the variance of the measurement.
    """
    variance, column = jnp.sum(jnp.square(row)) + noise, root @ row
    # Potter's update subtracts column columnᵀ / variance from the covariance without a difference of squares.
    return variance, column / jnp.sqrt(variance), root - column[:, None] * row / (variance + jnp.sqrt(noise * variance))


def correct(belief: Belief, sample: Sample, model: FilterModel) -> tuple[Belief, Correction]:
    """Process each measured number of a sample; innovations are clipped."""

    def process(belief, number):
        (z, root), (own, x, used, noise) = belief, number
        variance, gain, after = measured(jnp.where(used, own @ root, 0.0), root, noise)
        size = jnp.sqrt(variance)
        error = jnp.where(used, (x - own @ z) / size, 0.0)
        white = jnp.clip(error, -model.tuning.clip, model.tuning.clip)
        likelihood = jnp.where(used, -(jnp.square(white) + jnp.log(variance)) / 2, 0.0)
        return Belief(z + gain * white, after), Correction(error, white, size, gain, likelihood)

    own = jnp.eye(len(sample.x), len(belief.z), dtype=belief.z.dtype)
    numbers = own, sample.x, sample.used, model.variances
    belief, found = jax.lax.scan(process, belief, numbers)
    return model.project(belief), found._replace(log_likelihood=jnp.sum(found.log_likelihood))


def limit_covariance(belief: Belief, prior: Float[Array, " k"]) -> Belief:
    """Limit the variance of each number a to its prior."""
    z, root = belief
    d = len(z) - len(prior)
    variance, most = jnp.sum(jnp.square(root[d:]), axis=1), jnp.where(prior > 0, prior, 1.0)
    shrink = jnp.sqrt(most / jnp.maximum(variance, most))
    return Belief(z, jnp.concatenate([root[:d], shrink[:, None] * root[d:]]))


def diagonal_root(x: Float[Array, " d"], a: Float[Array, " k"]) -> Float[Array, "n n"]:
    """Return the `triangular` square root of a diagonal covariance with these variances."""
    own, state = jnp.diag(jnp.sqrt(a)), jnp.diag(jnp.sqrt(x))
    return jnp.concatenate([jnp.pad(state, ((0, 0), (len(a), 0))), jnp.pad(own, ((0, 0), (0, len(x))))])
