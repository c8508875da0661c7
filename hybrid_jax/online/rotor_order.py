"""Detect two exchanged rotors from the innovations of a filter.

With a wrong order of the rotors, innovations are small because a disturbance that moves quickly explains it, but they
are smaller with the right order. For each pair, a second filter with the gains of the first has its inputs exchanged. A
sequential test compares their likelihoods (Wald, "Sequential analysis", 1947, ch. 3): it accepts the exchange at a
log-ratio of ACCEPT, and restarts from −CLEAR at −REJECT. The change by one sample is limited (Huber, "A robust version
of the probability ratio test", 1965), so that a short model error, for example at the start of a gust, does not decide.
If two rotors are exchanged, the log-ratio falls to −CLEAR with a probability of at most e⁻⁵ (Ville's inequality).
"""

from collections.abc import Callable
from itertools import combinations

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from hybrid_jax.online.kalman import Belief, Correction, Field, FilterModel
from hybrid_jax.online.samples import Sample
from hybrid_jax.online.tuning import BOUND

ACCEPT, REJECT, CLEAR = 25.0, 10.0, 5.0  # logarithms of likelihood ratios
FASTEST = 50.0  # largest rate of their change [1/s], for a pace of 1: a decision takes half a second


class RotorOrder(eqx.Module):
    """The filters of h pairs of m rotors."""

    away: Float[Array, "*n h d+p"]  # their x and θ, less those of the first filter
    evidence: Float[Array, "*n h"]  # logarithm of how much likelier the exchange is
    orders: tuple[tuple[int, ...], ...] = eqx.field(static=True)

    @classmethod
    def begin(cls, rotors: int, n: int, dtype) -> "RotorOrder | None":
        """Return the state before the first sample; None if there is no pair."""
        pairs = [{i: j, j: i} for i, j in combinations(range(rotors), 2)]
        orders = tuple(tuple(pair.get(i, i) for i in range(rotors)) for pair in pairs)
        return cls(jnp.zeros((len(pairs), n), dtype), jnp.zeros(len(pairs), dtype), orders) if pairs else None

    @property
    def found(self) -> Bool[Array, "*n"]:
        """Whether two rotors are exchanged."""
        return jnp.max(self.evidence, axis=-1) >= ACCEPT

    @property
    def possible(self) -> Bool[Array, "*n"]:
        """Whether two rotors may be exchanged."""
        return jnp.max(self.evidence, axis=-1) > -CLEAR

    @property
    def exchanged(self) -> Bool[Array, "*n m"]:
        """Which rotors seem to be exchanged with another."""
        moved = np.array(self.orders) != np.arange(len(self.orders[0]))[None]
        found = self.evidence[..., None] >= ACCEPT
        return jnp.any(found & np.broadcast_to(moved, (*found.shape[:-1], moved.shape[1])), axis=-2)

    def after(
        self,
        before: Belief,
        rates: Callable[[Array], Field],
        slope: Float[Array, "d d+p"],
        after: Belief,
        correction: Correction,
        sample: Sample,
        alarmed: Bool[Array, ""],
        model: FilterModel,
    ) -> "RotorOrder":
        """Update after a sample, given the first filter's belief before and after it and the Jacobian of the next x."""
        d, clip, most = len(sample.x), model.tuning.clip, FASTEST * model.dt / model.tuning.pace
        x, theta = before.z[:d], before.z[d:]
        orders = jnp.asarray(np.eye(len(sample.u))[np.array(self.orders)], x.dtype)  # C has no gather
        own = model.each(lambda order, away: rates(order @ sample.u)(x, theta + away))(orders, self.away[:, d:])
        moved = self.away[:, :d] @ slope[:, :d].T + model.dt * (own - model.field(x, theta)[None])
        moved = jnp.where(sample.restart, 0.0, jnp.where(sample.acted, moved, self.away[:, :d]))
        away, ratio = jnp.concatenate([moved, self.away[:, d:]], axis=1), jnp.zeros_like(self.evidence)
        for i, error in enumerate(correction.errors):
            own = error - jnp.where(sample.used[i], away[:, i] / correction.sizes[i], 0.0)
            # Errors that no order explains do not count.
            first, second = (jnp.minimum(jnp.square(each), clip**2) for each in (error, own))
            ratio = ratio + (first - second) / 2
            added = jnp.clip(own, -clip, clip) - correction.white[i]
            away = away + added[:, None] * correction.gains[i, None]
        theta = after.z[None, d:]
        bounded = jnp.clip(theta + away[:, d:], -BOUND, BOUND) - theta
        away = jnp.concatenate([jnp.where(alarmed, 0.0, away[:, :d]), bounded], axis=1)
        evidence = self.evidence + jnp.clip(ratio, -most, most)
        kept = evidence > -REJECT  # false if it is NaN
        evidence = jnp.where(kept, jnp.minimum(evidence, 2 * ACCEPT), -CLEAR)
        return RotorOrder(jnp.where(kept[:, None], away, 0.0), evidence, self.orders)
