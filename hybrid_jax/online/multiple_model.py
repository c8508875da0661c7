"""A filter for each hypothesis, weighted by the likelihood of its innovations.

Most changes affect few parameters: a load, or the efficiency of one rotor. A filter of these converges after a few
samples, before a filter of all parameters can distinguish them. Bayes' rule weights the filters, as in the static
multiple-model estimator (Bar-Shalom, Li, Kirubarajan, "Estimation with applications to tracking and navigation", 2001,
ch. 11.6), and the estimate is the mixture's mean. The hypotheses are, in this order: no change since before the last
alarm; the field's own parameters; each hypothesis of the user; any change (the filter of all parameters, which is
stored elsewhere).

At the start, the first has weight one. An alarm resets each hypothesis to its prior. Weights have a lower bound, so
that a hypothesis can recover without an alarm.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from hybrid_jax.online import kalman
from hybrid_jax.online.change_test import ChangeTest
from hybrid_jax.online.hypotheses import ModelSet
from hybrid_jax.online.kalman import Belief, Correction, FilterModel
from hybrid_jax.online.samples import Sample
from hybrid_jax.online.tuning import SETTLE

FLOOR, CHANGE = 25.0, 4.0  # log-odds against a hypothesis: at most; and after an alarm, relative to no change
LEAST = 1e-3  # weight, relative to the largest, below which a hypothesis is not in the estimate


class Mixture(eqx.Module):
    """Filters of h hypotheses with equally many numbers, and h + 1 weights; θ in prior standard deviations."""

    z: Float[Array, "*n h d+k"]  # x and the numbers that move θ, for each hypothesis
    root: Float[Array, "*n h d+k d+k"]  # a square root of the covariance of each z
    previous: Float[Array, "*n h-1"]  # 1 for the hypothesis that the first one was before the last alarm, else 0
    log_weights: Float[Array, "*n h+1"]  # the largest 0; the last belongs to the filter of all parameters
    test: ChangeTest  # of the estimate


class Verdict(NamedTuple):
    """The result of all hypotheses after a sample."""

    mixture: Mixture | None  # None without hypotheses
    theta: Float[Array, " p"]  # the mean of the mixture
    squares: Float[Array, " d"]  # mean square of the mixture's white innovations
    changed: Bool[Array, ""]  # whether θ has changed
    unexplained: Bool[Array, ""]  # θ has changed but no hypothesis explains it, so the filter of all is reset


def initial(models: ModelSet, x: Float[Array, " d"], variances: Float[Array, " d"]) -> Mixture:
    h, p, k = models.effects.shape
    none = jnp.zeros(k, x.dtype)
    z = jnp.tile(jnp.concatenate([x, none]), (h + 1, 1))
    root = jnp.tile(kalman.diagonal_root(variances, none), (h + 1, 1, 1))
    before = jnp.zeros(h, x.dtype).at[0].set(1)
    log_weights = jnp.full(h + 2, -FLOOR, x.dtype).at[0].set(0)
    return Mixture(z, root, before, log_weights, ChangeTest.begin(p, x.dtype))


def weights(mixture: Mixture) -> Float[Array, " h+1"]:
    """Return the posterior weights; those below LEAST × max are set to zero."""
    found = jnp.maximum(jnp.exp(mixture.log_weights) - LEAST, 0.0)
    return found / jnp.sum(found)


def with_previous(mixture: Mixture, own: Float[Array | np.ndarray, "h-1 ..."]) -> Float[Array, "h ..."]:
    """Prepend the entry of the first hypothesis, which is one of the others before the last alarm."""
    own = jnp.asarray(own, mixture.z.dtype)
    before = mixture.previous.reshape(-1, *(1,) * (own.ndim - 1))
    return jnp.concatenate([jnp.sum(before * own, axis=0, keepdims=True), own])


def covariance(mixture: Mixture, models: ModelSet, joint: Belief) -> Float[Array, "p p"]:
    """Return the covariance of θ within the hypotheses (other parameters: of the joint filter) and between them."""
    share, means = weights(mixture), _means(mixture, models, joint)
    effects = with_previous(mixture, models.ahead)
    d = len(joint.z) - effects.shape[1]
    outside = jax.vmap(jnp.diag)(with_previous(mixture, models.outside) * jnp.diagonal(joint.covariance)[d:])
    within = effects @ mixture.root[:, d:]
    within = within @ within.mT + outside
    away = means - share @ means
    parts = jnp.concatenate([within, joint.covariance[None, d:, d:]]) + away[:, :, None] * away[:, None, :]
    return jnp.tensordot(share, parts, 1)


def _means(mixture: Mixture, models: ModelSet, joint: Belief) -> Float[Array, "h+1 p"]:
    """Return θ of each hypothesis, extrapolated by its lead."""
    effects = with_previous(mixture, models.ahead)
    d = len(joint.z) - effects.shape[1]
    return jnp.concatenate([jnp.sum(effects * mixture.z[:, None, d:], axis=2), joint.z[None, d:]])


def update(
    mixture: Mixture, models: ModelSet, model: FilterModel, sample: Sample, joint: Belief, correction: Correction
) -> Verdict:
    """Process a sample, given the filter of all parameters after its correction."""
    shares, periods = weights(mixture), model.dt / model.tuning.pace
    mixture, white, likelihoods = filtered(mixture, models, model, sample)
    white = jnp.concatenate([white, correction.white[None]])
    test, alarmed = mixture.test.after(correction._replace(white=shares @ white), sample, periods, model.tuning, SETTLE)
    changed = jnp.max(alarmed) > 0
    # Bayes' rule; a hypothesis at the floor stays there, except the filter of all parameters.
    before = mixture.log_weights
    likelihoods = jnp.concatenate([likelihoods, correction.log_likelihood[None]])
    log_weights = jnp.where((before <= -FLOOR).at[-1].set(False), -jnp.inf, before + likelihoods)
    log_weights = jnp.maximum(log_weights - jnp.max(log_weights), -FLOOR)
    mixture = eqx.tree_at(lambda m: m.log_weights, mixture, log_weights)
    # The filter of all parameters has found a change that the test has not.
    taken = (log_weights[-1] == 0) & (before[-1] < 0) & (mixture.test.quiet > SETTLE)
    unexplained, changed = changed & (log_weights[-1] < 0), changed | taken
    mixture = reinitialised(mixture, models, model, sample, changed)
    mixture = eqx.tree_at(lambda m: m.test, mixture, test.reset(taken, 0.0))
    theta = weights(mixture) @ _means(mixture, models, joint)
    return Verdict(mixture, theta, shares @ jnp.square(white), changed, unexplained)


def filtered(
    mixture: Mixture, models: ModelSet, model: FilterModel, sample: Sample
) -> tuple[Mixture, Float[Array, "h d"], Float[Array, " h"]]:
    """Update all hypotheses; also return their white innovations and log-likelihoods."""
    prior = with_previous(mixture, models.prior)
    drift = model.tuning.drift**2 / model.tuning.pace * prior
    diffusion = model.dt * sample.elapsed * (with_previous(mixture, models.diffusion) + drift)

    def one(z, root, effects, transition, prior, diffusion):
        def field(x, a):
            return model.field(x, jnp.sum(effects * a, axis=1))

        belief, _ = kalman.predict(Belief(z, root), model, field, transition, diffusion, sample.acted)
        belief = kalman.reset_state(kalman.limit_covariance(belief, prior), sample, sample.restart, model.variances)
        belief, correction = kalman.correct(belief, sample, model)
        return kalman.triangular(belief, len(sample.x)), correction.white, correction.log_likelihood

    effects, transition = with_previous(mixture, models.effects), with_previous(mixture, models.transition)
    belief, white, likelihood = model.each(one)(mixture.z, mixture.root, effects, transition, prior, diffusion)
    return eqx.tree_at(lambda m: (m.z, m.root), mixture, tuple(belief)), white, likelihood


def reinitialised(
    mixture: Mixture, models: ModelSet, model: FilterModel, sample: Sample, alarm: Bool[Array, ""]
) -> Mixture:
    """After an alarm, reset each hypothesis to its prior and keep the likeliest one as the first."""
    d, h = len(sample.x), len(mixture.z)
    likeliest = jnp.where(mixture.log_weights == 0, 1.0, 0.0)
    likeliest = likeliest / jnp.sum(likeliest)
    joint = likeliest[h]
    # The filter of all parameters continues elsewhere; if it is likeliest, the field's own parameters are the first.
    first = jnp.concatenate([likeliest[:1], likeliest[1:2] + joint, likeliest[2:h]])
    restart = jnp.concatenate([jnp.zeros_like(mixture.previous[:1]), jnp.ones_like(mixture.previous)])

    def one(z, root, prior, restart):
        begun = kalman.reset_state(Belief(z, root), sample, True, model.variances)
        fresh = kalman.diagonal_root(model.variances, prior)
        kept = jnp.concatenate([jnp.ones(d, z.dtype), jnp.full(len(prior), 1 - restart)])
        return Belief(kept * begun.z, jnp.concatenate([begun.root[:d], jnp.where(restart > 0, fresh, root)[d:]]))

    z = jnp.concatenate([(first @ mixture.z)[None], mixture.z[1:]])
    root = jnp.concatenate([jnp.tensordot(first, mixture.root, 1)[None], mixture.root[1:]])
    belief = model.each(one)(z, root, with_previous(mixture, models.prior), restart)
    # The filter of all parameters keeps its weight.
    least = jnp.full_like(mixture.log_weights, -CHANGE)
    log_weights = least.at[0].set(least[0] * joint).at[-1].set(jnp.maximum(mixture.log_weights[-1], least[0]))
    new = Mixture(belief.z, belief.root, first[0] * mixture.previous + first[1:], log_weights, mixture.test)
    return jax.tree.map(lambda a, b: jnp.where(alarm, a, b), new, mixture)
