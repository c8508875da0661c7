"""Move θ, and shrink its covariance, only along directions that the samples excite.

In hover, a thrust coefficient and a disturbance along z are distinguishable only by the controller's response to noise.
This noise is correlated with the input, so the filter becomes certain of a wrong value, with a bias of about BIAS / √I
of the prior, where I is the information of a sample in units of the prior. Directions with little information are
therefore considered, not estimated: they keep their value and variance, and add to the uncertainty of the others
(Schmidt, "Application of state-space methods to navigation problems", 1966). The others are corrected conditionally on
them, so that combinations which the samples determine, for example thrust over inertia, do not change. The information
is computed from the innovations' sensitivity to θ (Friedland, "Treatment of bias in recursive filtering", 1969).
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from hybrid_jax.online.kalman import Belief, Correction
from hybrid_jax.online.samples import Sample
from hybrid_jax.online.tuning import MEMORY, Tuning

BIAS = 0.04  # of the prior, for an information of 1 in a sample
LARGEST = 1e5  # information of a number, limited so that rounding does not count as information
SHARPER = 5  # iterations that make shares zero or one
LOOSE, LEAST = 1e-4, 1e-9  # relative variance of a condition; smallest share of a parameter
TAKES_PART = 0.1  # share above which a parameter is part of a direction that is not excited


class Excitation(eqx.Module):
    """Information of recent samples about p parameters, each over its share.

    `root` is a square root of the matrix with 1 / (1 + I / `Tuning.excitation`) instead of each eigenvalue I of the
    information of a sample.
    """

    sensitivity: Float[Array, "*n d p"]  # of the error of the estimated x to the error of θ
    root: Float[Array, "*n p p"]

    @classmethod
    def begin(cls, d: int, p: int, dtype) -> "Excitation":
        return cls(jnp.zeros((d, p), dtype), jnp.eye(p, dtype=dtype))

    def bias(self, tuning: Tuning) -> Float[Array, "*n p p"]:
        """Return the covariance of the bias of a hypothesis, which uses all information; see above."""
        size = BIAS**2 / tuning.excitation if tuning.excitation else 0.0
        return size * self.root @ self.root.mT

    def considered(self) -> Float[Array, "*n p p"]:
        """Return the projection on the directions that are not excited."""
        found = self.root @ self.root.mT
        for _ in range(SHARPER):
            twice = found @ found
            found = 3 * twice - 2 * twice @ found
        return found

    def estimated(self, share: Float[Array, " p"]) -> Float[Array, "*n p p"]:
        """Return the projection on the other directions, in units of the prior."""
        return jnp.eye(len(share), dtype=share.dtype) - share[:, None] * self.considered() / share


def after_sample(
    excitation: Excitation,
    slope: Float[Array, "d d+p"],
    correction: Correction,
    sample: Sample,
    walk: Float[Array, " p"],
    share: Float[Array, " p"],
    periods: float,
    tuning: Tuning,
) -> Excitation:
    """Update after a sample; `walk` is the random walk [1/√s] and `share` the weight of each parameter."""
    d, root = len(sample.x), excitation.root
    sensitivity = jnp.where(sample.restart, 0.0, slope[:, :d] @ excitation.sensitivity + slope[:, d:])
    sensitivity = jnp.where(sample.acted | sample.restart, sensitivity, excitation.sensitivity)
    new = jnp.where(sample.measured, -jnp.expm1(-periods / MEMORY), 0.0)
    root = root + new / 2 * (root - root @ (root.T @ root))
    noise = tuning.excitation / jnp.maximum(new, 1e-9)
    for i in range(d):
        seen = jnp.where(sample.used[i], sensitivity[i] / correction.sizes[i], 0.0)
        sensitivity = sensitivity - correction.gains[i, :d, None] * seen
        seen = share * seen / jnp.sqrt(1 + MEMORY * jnp.sum(jnp.square(seen * walk)))
        row = seen / jnp.sqrt(1 + jnp.sum(jnp.square(seen)) / LARGEST) @ root
        variance = jnp.sum(jnp.square(row)) + noise
        root = root - (root @ row)[:, None] * row / (variance + jnp.sqrt(noise * variance))  # as `kalman.correct`
    return Excitation(sensitivity, root)


def consider(
    before: Belief, after: Belief, correction: Correction, excited: Excitation, share: Float[Array, " p"]
) -> tuple[Belief, Correction]:
    """Correct θ on the condition that it does not move along considered directions; also return its new gains."""
    d, considered = len(correction.white), excited.considered()
    gains, root = correction.gains[:, d:], before.root[d:]
    moves = jnp.eye(len(share), dtype=root.dtype)
    sizes = jnp.sum(jnp.square(root), axis=1)
    # Process conditions one by one, like samples in `kalman.correct`: the measured change along `row` is zero.
    for i, row in enumerate(considered / share):
        parts = jnp.maximum(considered[i, i], LEAST)
        held = jnp.sum(jnp.square(considered[i])) / parts
        noise = (1 + LOOSE - jnp.minimum(held, 1.0)) / parts * jnp.sum(jnp.square(row) * sizes)
        seen = row @ root
        variance = jnp.maximum(jnp.sum(jnp.square(seen)) + noise, 1e-30)
        column = root @ seen
        moves = moves - column[:, None] * (row @ moves) / variance
        root = root - column[:, None] * seen / (variance + jnp.sqrt(noise * variance))
    held = gains - gains @ moves.T
    z = jnp.concatenate([after.z[:d], before.z[d:] + moves @ (after.z[d:] - before.z[d:])])
    added = jnp.concatenate([jnp.zeros((d, d), z.dtype), held.T])
    kept = jnp.concatenate([correction.gains[:, :d], gains - held], axis=1)
    return Belief(z, jnp.concatenate([after.root, added], axis=1)), correction._replace(gains=kept)
