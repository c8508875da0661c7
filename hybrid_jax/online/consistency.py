"""Can it be true what a filter says? Its model is used only while it can.

- While the mean of the normalised innovations squared (NIS) is far too large, no θ explains the samples (Bar-Shalom,
  Li, Kirubarajan, "Estimation with applications to tracking and navigation", 2001, ch. 5.4).
- Alarms that do not end, or a parameter at its bound, are not changes of the vehicle: a sensor has a wrong sign, unit
  or place. The estimate is then that before these alarms.
- A filter with a number that is not finite begins anew.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from hybrid_jax.online import kalman
from hybrid_jax.online.multiple_model import Verdict
from hybrid_jax.online.samples import HUGE, Sample
from hybrid_jax.online.state import OnlineState
from hybrid_jax.online.tuning import Tuning

AT_BOUND = 2.5  # alarms as which a parameter at its bound counts in a second
SETTLED = 0.5  # count of alarms below which an estimate is kept


def mean_square(nis: Float[Array, ""], squares: Float[Array, " d"], sample: Sample, periods: float) -> Float[Array, ""]:
    """The mean NIS with another sample, of a share of `periods` of the window."""
    share = jnp.sum(squares) / jnp.maximum(jnp.sum(jnp.where(sample.seen, 1.0, 0.0)), 1.0)
    return nis + jnp.where(sample.measured, -jnp.expm1(-periods), 0.0) * (share - nis)


def alarms(count: Float[Array, ""], verdict: Verdict, sample: Sample, dt: float, tuning: Tuning) -> Float[Array, ""]:
    """The count of alarms after another sample; once it is too large it is doubled, and so takes time to fall."""
    at_bound = sample.measured & (jnp.max(jnp.abs(verdict.theta)) >= tuning.bound)
    added = jnp.where(verdict.changed, 1.0, 0.0) + jnp.where(at_bound, AT_BOUND * dt, 0.0)
    counted = count * jnp.exp(-dt * sample.elapsed / tuning.trial) + added
    doubled = jnp.where(added > 0, 2 * tuning.alarms, counted)
    return jnp.where(counted >= tuning.alarms, doubled, counted)


def again(begun: OnlineState, old: OnlineState, variances: Float[Array, " d"]) -> OnlineState:
    """A beginning at the last good θ, with all parameters as uncertain as their prior."""
    root = kalman.diagonal_root(variances, jnp.ones_like(old.theta))
    values = old.trusted, old.trusted, old.settled, root, old.doubt, old.changes, old.restarts + 1
    begun = eqx.tree_at(
        lambda s: (s.theta, s.trusted, s.settled, s.root, s.doubt, s.changes, s.restarts), begun, values
    )
    if (mixture := begun.mixture) is not None:
        # It is for all parameters now.
        begun = eqx.tree_at(lambda s: s.mixture.log_weights, begun, mixture.log_weights[::-1])
    return begun


def sound(new: OnlineState, again: OnlineState) -> OnlineState:
    """The new state, or that which begins again if a number is not finite."""
    parts = [new.root, new.x, new.theta, new.nis, new.excitation.sensitivity, new.excitation.root]
    if new.mixture is not None:
        parts += [new.mixture.z, new.mixture.root, new.mixture.log_weights]
    total = sum(jnp.sum(jnp.abs(part)) for part in parts)
    return jax.tree.map(lambda a, b: jnp.where(total < HUGE, a, b), new, again)
