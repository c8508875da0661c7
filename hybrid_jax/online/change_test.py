"""A test for a change of parameters, by the innovations of a filter.

If noise and model are right, the corrections of a parameter are uncorrelated; if it has changed, they pull to one side.
Their exponentially weighted sum over its standard deviation is the test (the idea of the local approach: Benveniste,
Basseville, Moustakides, "The asymptotic local approach to change detection and model validation", 1987). It also sees
changes without a steady push, such as of an inertia.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from hybrid_jax.online.samples import Sample
from hybrid_jax.online.tuning import SPANS, Tuning

NOTHING = 1e-10  # variance of a sum of corrections that are rounding alone


class ChangeTest(eqx.Module):
    """Its sums for p parameters, over two spans of time.

    Attributes:
        pull: weighted sums of the corrections of θ.
        spread: their variances if nothing has changed.
        quiet: time since the last alarm, for a pace of 1 [s].
    """

    pull: Float[Array, "*n 2 p"]
    spread: Float[Array, "*n 2 p"]
    quiet: Float[Array, "*n"]

    @classmethod
    def begin(cls, p: int, dtype) -> "ChangeTest":
        """Before the first sample."""
        return cls(jnp.zeros((2, p), dtype), jnp.zeros((2, p), dtype), jnp.full((), 1e3, dtype))

    @property
    def pulled(self) -> Float[Array, " p"]:
        """The larger squared test of each parameter, of one degree of freedom."""
        return jnp.max(jnp.square(self.pull) / jnp.where(self.spread > NOTHING, self.spread, 1.0), axis=0)

    def after(
        self,
        white: Float[Array, " d"],
        gains: Float[Array, "d p"],
        sample: Sample,
        periods: float,
        tuning: Tuning,
        pause: float,
    ) -> tuple["ChangeTest", Bool[Array, ""]]:
        """The sums with the innovations of another sample, and whether they say that θ has changed.

        Args:
            white: innovations over their standard deviations.
            gains: of θ by these, which say what pulls at which parameter.
            periods: length of one, over the pace [s].
            pause: least time between two alarms [s].
        """
        kept = jnp.where(sample.measured, jnp.exp(-periods / jnp.asarray(SPANS, white.dtype)[:, None]), 1.0)
        pull = kept * self.pull + jnp.where(sample.measured, white @ gains, 0.0)
        spread = kept**2 * self.spread + jnp.where(sample.measured, jnp.sum(jnp.square(gains), axis=0), 0.0)
        summed = ChangeTest(pull, spread, self.quiet)
        alarmed = (jnp.max(summed.pulled) > tuning.alarm**2) & (self.quiet > pause)
        return summed.reset(alarmed, periods * sample.elapsed), alarmed

    def reset(self, alarmed: Bool[Array, ""], passed: Float[Array, ""] | float) -> "ChangeTest":
        """With empty sums after an alarm, else a time later."""
        pull, spread = (jnp.where(alarmed, 0.0, sums) for sums in (self.pull, self.spread))
        return ChangeTest(pull, spread, jnp.where(alarmed, 0.0, self.quiet + passed))
