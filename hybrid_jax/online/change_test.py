"""Detect a change of parameters from the innovations of a filter.

While noise and model are correct, the corrections of a parameter are uncorrelated; after a change they are biased. The
test statistic is their exponentially weighted sum over its standard deviation (local approach: Benveniste, Basseville,
Moustakides, "The asymptotic local approach to change detection and model validation", 1987). It also detects changes
that cause no constant force, for example in an inertia.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from hybrid_jax.online.kalman import Correction
from hybrid_jax.online.samples import Sample
from hybrid_jax.online.tuning import SPANS, Tuning

# Squared statistics (χ², one degree of freedom) above which a parameter and a disturbance take part in a change. With
# less, a gust would also reset a torque, which it affects through the tilt.
EAGER, PART = 6.0, 16.0
NOTHING = 1e-10  # variance of a sum of corrections that are only rounding


class ChangeTest(eqx.Module):
    """Test statistics for p parameters, over two time constants."""

    pull: Float[Array, "*n 2 p"]  # weighted sums of the corrections of θ
    spread: Float[Array, "*n 2 p"]  # variances of these sums without a change
    quiet: Float[Array, "*n"]  # time since the last alarm, for a pace of 1 [s]

    @classmethod
    def begin(cls, p: int, dtype) -> "ChangeTest":
        return cls(jnp.zeros((2, p), dtype), jnp.zeros((2, p), dtype), jnp.full((), 1e3, dtype))

    @property
    def pulled(self) -> Float[Array, " p"]:
        """The larger squared test statistic of each parameter, with one degree of freedom."""
        return jnp.max(jnp.square(self.pull) / jnp.where(self.spread > NOTHING, self.spread, 1.0), axis=0)

    def after(
        self,
        correction: Correction,
        sample: Sample,
        periods: float,
        tuning: Tuning,
        pause: float,
        least: Float[np.ndarray, " p"] | float = 0.0,
    ) -> tuple["ChangeTest", Float[Array, " p"]]:
        """Add the innovations of a sample; also return 1 for each parameter above `least` at an alarm, else 0."""
        white, gains = correction.white, correction.gains[:, -self.pull.shape[-1] :]
        kept = jnp.where(sample.measured, jnp.exp(-periods / jnp.asarray(SPANS, white.dtype)[:, None]), 1.0)
        pull = kept * self.pull + jnp.where(sample.measured, white @ gains, 0.0)
        spread = kept**2 * self.spread + jnp.where(sample.measured, jnp.sum(jnp.square(gains), axis=0), 0.0)
        summed = ChangeTest(pull, spread, self.quiet)
        alarmed = (jnp.max(summed.pulled) > tuning.alarm**2) & (self.quiet + periods / 2 > pause)
        changed = jnp.where(alarmed & (summed.pulled > least), 1.0, 0.0)
        return summed.reset(alarmed, periods * sample.elapsed), changed

    def reset(self, alarmed: Bool[Array, ""], passed: Float[Array, ""] | float) -> "ChangeTest":
        """Clear the sums after an alarm, else advance the time since the last one."""
        pull, spread = (jnp.where(alarmed, 0.0, sums) for sums in (self.pull, self.spread))
        return ChangeTest(pull, spread, jnp.where(alarmed, 0.0, self.quiet + passed))
