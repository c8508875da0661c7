"""Which directions of θ do the samples tell? Only along these does a filter move θ and become more certain.

In hover a thrust coefficient cannot be told from a disturbance along z but by what the controller does about noise.
Noise that the filter takes for motion is then correlated with the input, and in time it is sure of a wrong value, by a
bias of about 0.04 / √I of the prior, where I is the information of a sample on that direction, in units of the prior.
So a direction with little information is not estimated but considered: it stays, with its variance, and so does what
it adds to the uncertainty of all others (Schmidt, "Application of state-space methods to navigation problems", 1966).

The information is that of the innovations, by their sensitivity to θ, as of the filter of a bias in two stages
(Friedland, "Treatment of bias in recursive filtering", 1969).
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from hybrid_jax.online.kalman import Belief, Correction
from hybrid_jax.online.samples import Sample
from hybrid_jax.online.tuning import MEMORY, Tuning

LARGEST = 1e5  # information of a number beyond which its last digits would count for some
SHARPER = 5  # passes that make shares zero or one
TAKES_PART = 0.1  # share from which a parameter is part of what samples do not tell


class Excitation(eqx.Module):
    """What samples of late tell of p parameters.

    Attributes:
        sensitivity: of the error of the estimated x to that of θ.
        root: a square root of the matrix that has, in place of each eigenvalue I of the information of a sample,
            1 / (1 + I / `Tuning.excitation`); each parameter over its share.
    """

    sensitivity: Float[Array, "*n d p"]
    root: Float[Array, "*n p p"]

    @classmethod
    def begin(cls, d: int, p: int, dtype) -> "Excitation":
        """Before the first sample, which has told nothing."""
        return cls(jnp.zeros((d, p), dtype), jnp.eye(p, dtype=dtype))

    def considered(self) -> Float[Array, "*n p p"]:
        """The projection on the directions that samples do not tell."""
        found = self.root @ self.root.mT
        for _ in range(SHARPER):
            twice = found @ found
            found = 3 * twice - 2 * twice @ found
        return found


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
    """After a period with this Jacobian, and the sample at its end.

    Args:
        walk: of each parameter, its deviation after a second; what walks, as in gusts, hides what others do.
        share: of each, how willingly it takes what a sum of parameters explains.
        periods: length of one, over the pace [s].
    """
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
    before: Belief, after: Belief, correction: Correction, told: Excitation, share: Float[Array, " p"]
) -> tuple[Belief, Float[Array, "d p"]]:
    """What a sample corrected, but with θ where it was along what is considered; and the gains of θ."""
    d, considered = len(correction.white), told.considered() * share[:, None] / share
    gains = correction.gains[:, d:]
    held = gains @ considered.T
    z = jnp.concatenate([after.z[:d], after.z[d:] + considered @ (before.z[d:] - after.z[d:])])
    added = jnp.concatenate([jnp.zeros((d, d), z.dtype), held.T])
    return Belief(z, jnp.concatenate([after.root, added], axis=1)), gains - held
