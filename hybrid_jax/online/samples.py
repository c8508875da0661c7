"""Samples of a state, of which some numbers may be missing or frozen."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from hybrid_jax.state import QUATERNION

HUGE = 1e15  # a number beyond it, or NaN, was not measured


class Sample(NamedTuple):
    """What was measured at the end of a period, and what acted in it."""

    x: Float[Array, " d"]
    u: Float[Array, " m"]  # zero where it is unknown
    seen: Bool[Array, " d"]  # measured
    acted: Bool[Array, ""]  # one period has passed, with a known input
    anew: Bool[Array, ""]  # the state is taken from the sample
    elapsed: Float[Array, ""]  # periods

    @property
    def used(self) -> Bool[Array, " d"]:
        """What corrects the estimate."""
        return self.seen & ~self.anew

    @property
    def measured(self) -> Bool[Array, ""]:
        """Whether anything does; a sum in place of `any`, which the export to C does not know."""
        return jnp.sum(jnp.where(self.used, 1.0, 0.0)) > 0


class Heard(NamedTuple):
    """What samples were like until now."""

    last: Float[Array, " d"]  # the last sample
    equal: Float[Array, " d"]  # how many in a row were equal
    silent: Float[Array, ""]  # time since something was measured [s]


def sampled(x, u, elapsed, heard: Heard, dt: float, gap: float) -> tuple[Sample, Heard]:
    """The sample x after some periods of dt [s], and what they were like; after a gap [s] it begins anew."""
    equal = jnp.where(x == heard.last, heard.equal + 1, 0.0)
    seen = (jnp.abs(x) < HUGE) & (equal == 0)
    # Sums in place of `all` and `any`, which the export to C does not know.
    acted = (jnp.sum(jnp.where(jnp.abs(u) < HUGE, 0.0, 1.0)) == 0) & (elapsed < 1.5)
    any_seen = jnp.sum(jnp.where(seen, 1.0, 0.0)) > 0
    waited = heard.silent + dt * (elapsed - 1)
    silent = jnp.where(any_seen, dt * (elapsed - 1), waited + dt)
    anew = any_seen & (~acted | (waited > gap))
    held = jnp.where(jnp.abs(u) < HUGE, u, 0.0)
    return Sample(x, held, seen, acted, anew, jnp.asarray(elapsed, x.dtype)), Heard(x, equal, silent)


def nearer(x: Float[Array, " d"], to: Float[Array, " d"]) -> Float[Array, " d"]:
    """x of a rigid body with the sign of its quaternion that is nearer."""
    other = jnp.sum(x[QUATERNION] * to[QUATERNION]) < 0
    return x.at[QUATERNION].set(jnp.where(other, -x[QUATERNION], x[QUATERNION]))
