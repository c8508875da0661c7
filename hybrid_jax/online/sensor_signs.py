"""Detect a state that is measured with the wrong sign, for example a yaw rate, from the states whose rate it is.

A disturbance that moves quickly explains a wrong sign of a velocity, so innovations stay small. But no disturbance acts
on a position: its change over some 0.2 s is the integral of the velocity. For each disturbed state, a sequential test
compares how likely the changes of undisturbed states are with its sample and with the negative sample (Page,
"Continuous inspection schemes", 1954). Noise of the sample counts against the wrong sign.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from hybrid_jax.online.kalman import Belief, FilterModel
from hybrid_jax.online.rotor_order import FASTEST
from hybrid_jax.online.samples import Sample
from hybrid_jax.state_space import StateSpace

SPAN = 0.2  # s, over which changes are compared, for a pace of 1
ACCEPT, SUSPECT = 12.0, 1.0  # log-likelihood ratios above which a sign is wrong, and may be wrong


class SensorSigns(eqx.Module):
    """The test of j disturbed states among d."""

    last: Float[Array, "*n d"]  # the last sample; the estimate where nothing was measured
    errors: Float[Array, "*n d"]  # recent changes of each state less the integral of its rate
    effects: Float[Array, "*n j d"]  # part of the errors due to a wrong sign of each disturbed state
    evidence: Float[Array, "*n j"]  # logarithm of how much likelier the wrong sign is; at least 0
    disturbed: tuple[int, ...] = eqx.field(static=True)

    @classmethod
    def begin(cls, space: StateSpace, x: Float[Array, " d"]) -> "SensorSigns | None":
        """Return the state at the first sample x; None if the state space does not say which states are disturbed."""
        disturbed, none = tuple(range(len(x))[space.disturbed or slice(0)]), jnp.zeros_like(x)
        if not disturbed:
            return None
        return cls(x, none, jnp.zeros((len(disturbed), len(x)), x.dtype), none[: len(disturbed)], disturbed)

    @property
    def found(self) -> Bool[Array, "*n"]:
        """Whether a sign is wrong."""
        return jnp.max(self.evidence, axis=-1) >= ACCEPT

    @property
    def possible(self) -> Bool[Array, "*n"]:
        """Whether a sign may be wrong."""
        return jnp.max(self.evidence, axis=-1) > SUSPECT

    @property
    def reversed(self) -> Bool[Array, "*n d"]:
        """Which states seem to be measured with the wrong sign."""
        wrong = jnp.zeros(self.last.shape, bool)
        return wrong.at[..., np.array(self.disturbed)].set(self.evidence >= ACCEPT)

    def after(self, slope: Float[Array, "d d+p"], after: Belief, sample: Sample, model: FilterModel) -> "SensorSigns":
        """Update after a sample, given the Jacobian of the next x and the belief."""
        d, periods, tested = len(sample.x), model.dt / model.tuning.pace, np.array(self.disturbed)
        kept, most, free = float(np.exp(-periods / SPAN)), FASTEST * periods, np.ones(d)
        free[tested] = 0.0
        x = jnp.where(sample.seen, sample.x, after.z[:d])
        middle, gains = (x + self.last) / 2, slope[:, tested].T
        change = x - self.last - model.dt * model.field(middle, after.z[d:])
        acted = sample.acted & ~sample.restart
        errors = jnp.where(acted, kept * self.errors + change, 0.0)
        effects = jnp.where(acted, kept * self.effects - 2 * middle[tested, None] * gains, 0.0)
        # Samples within one span are not independent, and the noise of the rates adds up.
        noise = jnp.square(gains) * model.variances[tested, None] / (1 - kept**2)
        counted = (1 - kept) * jnp.where(sample.seen, free, 0.0) / (model.variances + jnp.sum(noise, axis=0))
        ratio = jnp.sum(counted * (effects * errors - jnp.square(effects) / 2 - 2 * noise), axis=1)
        evidence = self.evidence + jnp.where(sample.seen[tested], jnp.clip(ratio, -most, most), 0.0)
        evidence = jnp.where(evidence > 0, jnp.minimum(evidence, 2 * ACCEPT), 0.0)  # also if NaN
        return SensorSigns(x, errors, effects, evidence, self.disturbed)
