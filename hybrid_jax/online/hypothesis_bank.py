"""Which cause explains the samples? A filter for each, weighed by the likelihood of its innovations.

A change is mostly one of few parameters: those of a load, or the efficiency of one rotor. A filter of these alone knows
them after a few samples, where a filter of all parameters has to tell them from each other first. Which one it was, the
samples say: each filter predicts them, and Bayes' rule weighs the filters by how likely they were, as in the static
multiple-model estimator (Bar-Shalom, Li, Kirubarajan, "Estimation with applications to tracking and navigation", 2001,
ch. 11.6). The estimate is that of their mixture. The hypotheses are, in this order:

- it is as it was before the last alarm,
- the parameters are the field's own,
- one of the causes has changed them,
- anything has: the filter of all parameters, which lies elsewhere.

At the start the first is certain, so that the estimate stays as it is until a change is found. An alarm opens each
cause to its prior. Weights have a lower bound, so that a hypothesis may come back without an alarm.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from hybrid_jax.online import change_test, kalman
from hybrid_jax.online.change_test import ChangeTest, started
from hybrid_jax.online.hypotheses import Bank
from hybrid_jax.online.kalman import Belief, Correction, Plant
from hybrid_jax.online.samples import Sample


class Mixture(eqx.Module):
    """The state of h hypotheses of as many numbers each, and the weight of one more; θ in prior standard deviations."""

    z: Float[Array, "*n h d+k"]  # x, and numbers that move θ
    covariance: Float[Array, "*n h d+k d+k"]
    before: Float[Array, "*n h-1"]  # 1 for the one of the others that the first was before the last alarm
    odds: Float[Array, "*n h+1"]  # logarithms, the largest 0; the last is the filter of all parameters
    test: ChangeTest  # of the estimate


class Verdict(NamedTuple):
    """What the hypotheses say after a sample."""

    mixture: Mixture
    theta: Float[Array, " p"]  # of the mixture
    squares: Float[Array, " d"]  # of its innovations over their standard deviations
    found: Bool[Array, ""]  # θ has changed
    lost: Bool[Array, ""]  # and no hypothesis explains it, so that the filter of all parameters is to open


def begun(bank: Bank, x: Float[Array, " d"], variances: Float[Array, " d"], floor: float) -> Mixture:
    """Before the first sample x."""
    h, p, k = bank.effects.shape
    none = jnp.zeros(k, x.dtype)
    z = jnp.tile(jnp.concatenate([x, none]), (h + 1, 1))
    covariance = jnp.tile(jnp.diag(jnp.concatenate([variances, none])), (h + 1, 1, 1))
    before = jnp.zeros(h, x.dtype).at[0].set(1)
    odds = jnp.full(h + 2, -floor, x.dtype).at[0].set(0)
    return Mixture(z, covariance, before, odds, started(p, x.dtype))


def weights(mixture: Mixture, least: float) -> Float[Array, " h+1"]:
    """Of the hypotheses; exactly zero for one that has less than `least` of the largest."""
    found = jnp.maximum(jnp.exp(mixture.odds) - least, 0.0)
    return found / jnp.sum(found)


def of_all(mixture: Mixture, own: Float[Array | np.ndarray, "h-1 ..."]) -> Float[Array, "h ..."]:
    """Arrays of the bank with those of the first hypothesis, which is one of the others as it was."""
    own = jnp.asarray(own, mixture.z.dtype)
    before = mixture.before.reshape(-1, *(1,) * (own.ndim - 1))
    return jnp.concatenate([jnp.sum(before * own, axis=0, keepdims=True), own])


def mean(mixture: Mixture, bank: Bank, joint: Belief, least: float) -> Float[Array, " p"]:
    """θ of the mixture, as far ahead as causes say."""
    return weights(mixture, least) @ _means(mixture, bank, joint)


def covariance(mixture: Mixture, bank: Bank, joint: Belief, least: float) -> Float[Array, "p p"]:
    """Of θ in the mixture: that within its parts, and of these around the mean.

    A parameter for which a cause has no number of its own may have changed by as much as the samples would not tell:
    its variance is that in the filter of all parameters.
    """
    share, means, effects = weights(mixture, least), _means(mixture, bank, joint), of_all(mixture, bank.ahead)
    d = len(joint.z) - effects.shape[1]
    untold = jax.vmap(jnp.diag)(of_all(mixture, bank.untold) * kalman.diagonal(joint.covariance)[d:])
    within = jnp.einsum("hpk,hkl,hql->hpq", effects, mixture.covariance[:, d:, d:], effects) + untold
    away = means - share @ means
    parts = jnp.concatenate([within, joint.covariance[None, d:, d:]]) + away[:, :, None] * away[:, None, :]
    return jnp.tensordot(share, parts, 1)


def _means(mixture: Mixture, bank: Bank, joint: Belief) -> Float[Array, "h+1 p"]:
    effects = of_all(mixture, bank.ahead)
    d = len(joint.z) - effects.shape[1]
    return jnp.concatenate([jnp.sum(effects * mixture.z[:, None, d:], axis=2), joint.z[None, d:]])


def after_sample(
    mixture: Mixture, bank: Bank, plant: Plant, sample: Sample, joint: Belief, correction: Correction
) -> Verdict:
    """After a sample, with the filter of all parameters as that sample corrected it."""
    tuning, shares = plant.tuning, weights(mixture, plant.tuning.least)
    mixture, white, likelihoods = corrected(mixture, bank, plant, sample)
    white = jnp.concatenate([white, correction.white[None]])
    pulled = shares @ white, correction.gains
    test, found = change_test.after_sample(mixture.test, *pulled, sample, plant.dt, tuning, tuning.settle)
    likelihoods = jnp.concatenate([likelihoods, correction.likelihood[None]])
    before, mixture = mixture.odds[-1], weighed(mixture, likelihoods, tuning.floor)
    # The filter of all parameters has found what the test has not.
    taken = (mixture.odds[-1] == 0) & (before < 0) & (mixture.test.quiet > tuning.settle)
    lost, found = found & (mixture.odds[-1] < 0), found | taken
    mixture = opened(mixture, bank, plant, sample, found)
    mixture = eqx.tree_at(lambda m: m.test, mixture, change_test.reset(test, taken, 0.0))
    return Verdict(mixture, mean(mixture, bank, joint, tuning.least), shares @ jnp.square(white), found, lost)


def corrected(
    mixture: Mixture, bank: Bank, plant: Plant, sample: Sample
) -> tuple[Mixture, Float[Array, "h d"], Float[Array, " h"]]:
    """After a sample, in which all hypotheses learn; and of each the white innovations and their likelihood."""
    prior = of_all(mixture, bank.prior)
    walked = plant.dt * sample.elapsed * (of_all(mixture, bank.walked) + plant.tuning.drift**2 * prior)

    def one(z, covariance, effects, turned, prior, walked):
        def field(x, a):
            return plant.field(x, jnp.sum(effects * a, axis=1))

        belief = kalman.predict(Belief(z, covariance), plant, field, turned, walked, sample.acted)
        belief = kalman.restarted(kalman.capped(belief, prior), sample, sample.anew, plant.variances)
        belief, correction = kalman.correct(belief, sample, plant)
        return belief, correction.white, correction.likelihood

    effects, turned = of_all(mixture, bank.effects), of_all(mixture, bank.turned)
    belief, white, likelihood = plant.each(one)(mixture.z, mixture.covariance, effects, turned, prior, walked)
    return eqx.tree_at(lambda m: (m.z, m.covariance), mixture, tuple(belief)), white, likelihood


def weighed(mixture: Mixture, likelihoods: Float[Array, " h+1"], floor: float) -> Mixture:
    """With Bayes' rule for the weights; what is at the floor stays there but for the filter of all parameters."""
    stays = (mixture.odds <= -floor).at[-1].set(False)
    odds = jnp.where(stays, -jnp.inf, mixture.odds + likelihoods)
    return eqx.tree_at(lambda m: m.odds, mixture, jnp.maximum(odds - jnp.max(odds), -floor))


def opened(mixture: Mixture, bank: Bank, plant: Plant, sample: Sample, alarm: Bool[Array, ""]) -> Mixture:
    """After an alarm: each cause anew at its prior, and the likeliest hypothesis as it is beside them."""
    d, h = len(sample.x), len(mixture.z)
    leads = jnp.where(mixture.odds == 0, 1.0, 0.0)
    leads = leads / jnp.sum(leads)
    joint = leads[h]
    # The filter of all parameters goes on by itself; the field's own parameters then take the first place.
    first = jnp.concatenate([leads[:1], leads[1:2] + joint, leads[2:h]])
    anew = jnp.concatenate([jnp.zeros_like(mixture.before[:1]), jnp.ones_like(mixture.before)])

    def one(z, covariance, prior, anew):
        none = jnp.concatenate([jnp.ones(d, z.dtype), jnp.full(len(prior), 1 - anew)])
        covariance = none[:, None] * covariance * none + jnp.diag(
            jnp.concatenate([jnp.zeros(d, z.dtype), prior]) * anew
        )
        return kalman.restarted(Belief(none * z, covariance), sample, True, plant.variances)

    z = jnp.concatenate([(first @ mixture.z)[None], mixture.z[1:]])
    covariance = jnp.concatenate([jnp.tensordot(first, mixture.covariance, 1)[None], mixture.covariance[1:]])
    belief = plant.each(one)(z, covariance, of_all(mixture, bank.prior), anew)
    # What learns goes on with its weight.
    least = jnp.full_like(mixture.odds, -plant.tuning.change)
    odds = least.at[0].set(least[0] * joint).at[-1].set(jnp.maximum(mixture.odds[-1], least[0]))
    new = Mixture(belief.z, belief.covariance, first[0] * mixture.before + first[1:], odds, mixture.test)
    return jax.tree.map(lambda a, b: jnp.where(alarm, a, b), new, mixture)
