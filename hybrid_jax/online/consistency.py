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
from hybrid_jax.online.tuning import TRIAL, WINDOW, Tuning

AT_BOUND = 2.5  # alarms as which a parameter at its bound counts in a second
SETTLED = 0.5  # count of alarms below which an estimate is kept


def believed(
    state: OnlineState, verdict: Verdict, sample: Sample, periods: float, tuning: Tuning
) -> dict[str, Float[Array, "..."]]:
    """The guard's parts of the next state: mean NIS, count of alarms, θ that is used, and that before alarms began."""
    share = jnp.sum(verdict.squares) / jnp.maximum(jnp.sum(jnp.where(sample.seen, 1.0, 0.0)), 1.0)
    nis = state.nis + jnp.where(sample.measured, -jnp.expm1(-periods / WINDOW), 0.0) * (share - state.nis)
    at_bound = sample.measured & (jnp.max(jnp.abs(verdict.theta)) >= tuning.bound)
    added = jnp.where(verdict.changed, 1.0, 0.0) + jnp.where(at_bound, AT_BOUND * periods, 0.0)
    counted = state.doubt * jnp.exp(-periods * sample.elapsed / TRIAL) + added
    # Once it is too large it is doubled, and so takes time to fall.
    doubled = jnp.where(added > 0, 2 * tuning.alarms, counted)
    doubt = jnp.where(counted >= tuning.alarms, doubled, counted)
    trusted = jnp.where(nis < tuning.reject, verdict.theta, state.trusted)
    trusted = jnp.where(doubt < tuning.alarms, trusted, state.settled)
    settled = jnp.where(doubt < SETTLED, trusted, state.settled)
    return {"nis": nis, "doubt": doubt, "trusted": trusted, "settled": settled}


def sound(new: OnlineState, begun: OnlineState, old: OnlineState, variances: Float[Array, " d"]) -> OnlineState:
    """The new state, or if a number is not finite a beginning at the last good θ, as uncertain as the prior."""
    root = kalman.diagonal_root(variances, jnp.ones_like(old.theta))
    values = old.trusted, old.trusted, old.settled, root, old.doubt, old.changes, old.restarts + 1
    again = eqx.tree_at(
        lambda s: (s.theta, s.trusted, s.settled, s.root, s.doubt, s.changes, s.restarts), begun, values
    )
    parts = [new.root, new.x, new.theta, new.nis, new.excitation.sensitivity, new.excitation.root]
    if (mixture := again.mixture) is not None and new.mixture is not None:
        # It is for all parameters now.
        again = eqx.tree_at(lambda s: s.mixture.log_weights, again, mixture.log_weights[::-1])
        parts += [new.mixture.z, new.mixture.root, new.mixture.log_weights]
    total = sum(jnp.sum(jnp.abs(part)) for part in parts)
    return jax.tree.map(lambda a, b: jnp.where(total < HUGE, a, b), new, again)
