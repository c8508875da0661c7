"""Samples of a state with missing or frozen numbers."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

HUGE = 1e15  # larger numbers, or NaN, were not measured


class Sample(NamedTuple):
    """A measurement at the end of a period and the input over the period."""

    x: Float[Array, " d"]
    u: Float[Array, " m"]  # zero where it is unknown
    seen: Bool[Array, " d"]  # whether each number was measured
    acted: Bool[Array, ""]  # whether exactly one period has passed with a known input
    restart: Bool[Array, ""]  # whether the state is reset to the sample
    elapsed: Float[Array, ""]  # periods since the last sample

    @property
    def used(self) -> Bool[Array, " d"]:
        """Whether each number corrects the estimate."""
        return self.seen & ~self.restart

    @property
    def measured(self) -> Bool[Array, ""]:
        """Whether any number corrects it; a sum, because the export to C does not support `any`."""
        return jnp.sum(jnp.where(self.used, 1.0, 0.0)) > 0


class SampleHistory(NamedTuple):
    """Statistics of the past samples."""

    last: Float[Array, "*n d"]  # measured values
    equal: Float[Array, "*n d"]  # number of equal samples in a row
    silent: Float[Array, "*n"]  # time since the last measurement [s]
    unseen: Float[Array, "*n d"]  # 1 where the last sample was not used, else 0


def classify(x, u, elapsed, history: SampleHistory, dt: float, gap: float) -> tuple[Sample, SampleHistory]:
    """Classify the sample x after some periods of dt [s]; after a `gap` [s] the state restarts from it."""
    equal = jnp.where(x == history.last, history.equal + 1, 0.0)
    seen = (jnp.abs(x) < HUGE) & (equal == 0)
    # Sums instead of `all` and `any`, which the export to C does not support.
    acted = (jnp.sum(jnp.where(jnp.abs(u) < HUGE, 0.0, 1.0)) == 0) & (elapsed < 1.5)
    any_seen = jnp.sum(jnp.where(seen, 1.0, 0.0)) > 0
    waited = history.silent + dt * (elapsed - 1)
    silent = jnp.where(any_seen, dt * (elapsed - 1), waited + dt)
    restart = any_seen & (~acted | (waited > gap))
    held = jnp.where(jnp.abs(u) < HUGE, u, 0.0)
    last, unseen = jnp.where(jnp.abs(x) < HUGE, x, history.last), jnp.where(seen, 0.0, 1.0)
    sample = Sample(x, held, seen, acted, restart, jnp.asarray(elapsed, x.dtype))
    return sample, SampleHistory(last, equal, silent, unseen)
