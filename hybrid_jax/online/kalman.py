"""Steps of an extended Kalman filter of z = [x, a]: the state of a system, and numbers a that move its parameters.

Samples enter one number after the other, so that an update needs no matrix inverse (Bierman, "Factorization methods for
discrete sequential estimation", 1977, ch. V.2). All functions are pure and map over filters of one size.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from hybrid_jax.integrate import rk4_step
from hybrid_jax.online.samples import Sample
from hybrid_jax.online.tuning import Tuning

Each = Callable[[Callable], Callable]  # a function of one filter → of arrays of several, as `jax.vmap`
Field = Callable[[Array, Array], Array]  # ẋ as a function of x and a


class Belief(NamedTuple):
    """Mean and covariance of z."""

    z: Float[Array, " n"]
    covariance: Float[Array, "n n"]


class FilterModel(NamedTuple):
    """What all filters have in common in a period.

    Attributes:
        field: ẋ as a function of x and θ, under the input of the period.
        unit: the state x as it is usually given, such as with a unit quaternion; see `StateSpace.normalise`.
        variances: of a sample.
        process_noise: variance that a period adds to x.
        dt: length of a period [s].
        tuning: of the filters.
        each: turns a function of one filter into one of arrays of several.
    """

    field: Field
    unit: Callable[[Array], Array]
    variances: Float[Array, " d"]
    process_noise: Float[Array, " d"]
    dt: float
    tuning: Tuning
    each: Each

    def tidy(self, belief: Belief) -> Belief:
        """With a unit quaternion, and a within its bounds."""
        z, d, bound = belief.z, len(self.variances), self.tuning.bound
        return Belief(jnp.concatenate([self.unit(z[:d]), jnp.clip(z[d:], -bound, bound)]), belief.covariance)


class Correction(NamedTuple):
    """What a sample did.

    Attributes:
        white: innovations over their standard deviations.
        gains: of the numbers a by these.
        log_likelihood: of the sample, but for a constant.
    """

    white: Float[Array, " d"]
    gains: Float[Array, "d k"]
    log_likelihood: Float[Array, ""]


def step_with_jacobian(
    model: FilterModel, field: Field, x: Float[Array, " d"], a: Float[Array, " k"]
) -> tuple[Array, Array]:
    """The next x by RK4, and its Jacobian in x and a, which one Jacobian of ẋ midway gives up to O(dt³)."""
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
) -> Belief:
    """One period later, if a known input acted in it.

    Args:
        field: ẋ as a function of x and a.
        transition: the next a as a matrix times a; None if it stays.
        diffusion: variance that the period adds to a.
    """
    z, covariance = belief
    d = len(model.variances)
    moved, slope = step_with_jacobian(model, field, z[:d], z[d:])
    top, own = slope @ covariance, covariance[d:, d:]
    inner, beside, a = top @ slope.T, top[:, d:], z[d:]
    by_a = slope[:, d:]
    # Products of errors of a and of x, which a linear filter leaves out, move the state while a is uncertain.
    noise = model.process_noise + model.tuning.caution**2 * jnp.sum((by_a @ own) * by_a, axis=1)
    if transition is not None:
        beside, own, a = beside @ transition.T, transition @ own @ transition.T, transition @ a
    later = jnp.block([[inner, beside], [beside.T, own]])
    later = jnp.where(acted, (later + later.T) / 2, covariance) + jnp.diag(jnp.concatenate([noise, diffusion]))
    return Belief(jnp.where(acted, jnp.concatenate([moved, a]), z), later)


def reset_state(
    belief: Belief, sample: Sample, restart: Bool[Array, ""] | bool, variances: Float[Array, " d"]
) -> Belief:
    """With x as the sample has it, if `restart`; a stays."""
    z, covariance = belief
    d, k = len(variances), len(z) - len(variances)
    kept = jnp.concatenate([jnp.full(d, jnp.where(restart, 0.0, 1.0), z.dtype), jnp.ones(k, z.dtype)])
    variance = jnp.where(sample.seen, variances, 1e4 * variances)
    added = jnp.concatenate([jnp.where(restart, variance, 0.0), jnp.zeros(k, z.dtype)])
    z = jnp.concatenate([jnp.where(restart & sample.seen, sample.x, z[:d]), z[d:]])
    return Belief(z, kept[:, None] * covariance * kept + jnp.diag(added))


def correct(belief: Belief, sample: Sample, model: FilterModel) -> tuple[Belief, Correction]:
    """With one measured number after the other; innovations are cut off at some standard deviations."""
    (z, covariance), variances, clip = belief, model.variances, model.tuning.clip
    d = len(variances)
    white, gains, likelihood = [], [], jnp.zeros((), z.dtype)
    for i in range(d):
        used, column = sample.used[i], covariance[:, i]
        variance = column[i] + variances[i]
        size = jnp.sqrt(variance)
        error = jnp.where(used, jnp.clip((sample.x[i] - z[i]) / size, -clip, clip), 0.0)
        gain = jnp.where(used, column / size, 0.0)
        z, covariance = z + gain * error, covariance - gain[:, None] * gain
        likelihood = likelihood - jnp.where(used, jnp.square(error) + jnp.log(variance), 0.0) / 2
        white.append(error)
        gains.append(gain[d:])
    return model.tidy(Belief(z, covariance)), Correction(jnp.stack(white), jnp.stack(gains), likelihood)


def limit_covariance(belief: Belief, prior: Float[Array, " k"]) -> Belief:
    """No number a becomes less certain than the prior, also if nothing excites it for long."""
    z, covariance = belief
    variance = diagonal(covariance)[len(z) - len(prior) :]
    most = jnp.where(prior > 0, prior, 1.0)
    shrink = jnp.concatenate([jnp.ones(len(z) - len(prior), z.dtype), jnp.sqrt(most / jnp.maximum(variance, most))])
    return Belief(z, shrink[:, None] * covariance * shrink)


def diagonal(matrix: Float[Array, "n n"]) -> Float[Array, " n"]:
    """As jnp.diagonal, by operations that the export to C knows."""
    return matrix.ravel()[:: len(matrix) + 1]
