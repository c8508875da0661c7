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
from hybrid_jax.online.tuning import Tuning

NOTHING = 1e-10  # variance of a sum of corrections that are rounding alone


class ChangeTest(eqx.Module):
    """Its sums for p parameters, over two spans of time.

    Attributes:
        pull: weighted sums of the corrections of θ.
        spread: their variances if nothing has changed.
        quiet: time since the last alarm [s].
    """

    pull: Float[Array, "*n 2 p"]
    spread: Float[Array, "*n 2 p"]
    quiet: Float[Array, "*n"]

    @property
    def squares(self) -> Float[Array, "2 p"]:
        """The squared test of each parameter, of one degree of freedom."""
        return jnp.square(self.pull) / jnp.where(self.spread > NOTHING, self.spread, 1.0)


def started(p: int, dtype) -> ChangeTest:
    """Before the first sample."""
    sums = jnp.zeros((2, p), dtype)
    return ChangeTest(sums, sums, jnp.full((), 1e3, dtype))


def after_sample(
    test: ChangeTest,
    white: Float[Array, " d"],
    gains: Float[Array, "d p"],
    sample: Sample,
    dt: float,
    tuning: Tuning,
    pause: float,
) -> tuple[ChangeTest, Bool[Array, ""]]:
    """The sums with the innovations of another sample, and whether they say that θ has changed.

    Args:
        white: innovations over their standard deviations.
        gains: of θ by these, which say what pulls at which parameter.
        pause: least time between two alarms [s].
    """
    kept = jnp.where(sample.measured, jnp.exp(-dt / jnp.asarray(tuning.spans, white.dtype)[:, None]), 1.0)
    pull = kept * test.pull + jnp.where(sample.measured, white @ gains, 0.0)
    spread = kept**2 * test.spread + jnp.where(sample.measured, jnp.sum(jnp.square(gains), axis=0), 0.0)
    summed = ChangeTest(pull, spread, test.quiet)
    alarmed = (jnp.max(summed.squares) > tuning.alarm**2) & (test.quiet > pause)
    return reset(summed, alarmed, dt * sample.elapsed), alarmed


def reset(test: ChangeTest, alarmed: Bool[Array, ""], passed: Float[Array, ""] | float) -> ChangeTest:
    """With empty sums after an alarm, else a time later."""
    pull, spread = (jnp.where(alarmed, 0.0, sums) for sums in (test.pull, test.spread))
    return ChangeTest(pull, spread, jnp.where(alarmed, 0.0, test.quiet + passed))
