"""Use a filter's model only while it is consistent with the samples.

A large mean of the normalised innovations squared (NIS) means that no θ explains the samples (Bar-Shalom, Li,
Kirubarajan, "Estimation with applications to tracking and navigation", 2001, ch. 5.4). Persistent alarms, or a
parameter at its bound, indicate a sensor with a wrong sign, unit or position. The estimate then returns to its value
before the alarms, as with exchanged rotors (`rotor_order`) or a wrong sign (`sensor_signs`). A filter with a number
that is not finite restarts.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from hybrid_jax.online import kalman
from hybrid_jax.online.multiple_model import Verdict
from hybrid_jax.online.rotor_order import RotorOrder
from hybrid_jax.online.samples import HUGE, Sample
from hybrid_jax.online.sensor_signs import SensorSigns
from hybrid_jax.online.state import OnlineState
from hybrid_jax.online.tuning import ALARMS, BOUND, BURST, REJECT, TRIAL, WINDOW

NEAR = 0.95  # share of its bound above which a parameter is at its bound
PERSISTENT = 5.0  # alarms per second while a parameter is at its bound or errors are unlikely
UNLIKELY = 0.5  # share of REJECT above which errors count as alarms, and as a burst after half a second
SETTLED = 0.5  # count of alarms below which an estimate is kept


def update(
    state: OnlineState,
    verdict: Verdict,
    faults: tuple[RotorOrder | SensorSigns | None, ...],
    sample: Sample,
    periods: float,
) -> dict[str, Float[Array, "..."]]:
    """Compute the consistency fields of the next state: mean NIS, alarms, and θ in use and before the alarms."""
    share = jnp.sum(verdict.squares) / jnp.maximum(jnp.sum(jnp.where(sample.seen, 1.0, 0.0)), 1.0)
    nis = state.nis + jnp.where(sample.measured, -jnp.expm1(-periods / WINDOW), 0.0) * (share - state.nis)
    at_bound = sample.measured & (jnp.max(jnp.abs(verdict.theta)) >= NEAR * BOUND)
    alarm, unlikely = jnp.where(verdict.changed, 1.0, 0.0), nis > UNLIKELY * REJECT
    added = alarm + jnp.where(at_bound | unlikely, PERSISTENT * periods, 0.0)
    counted = state.alarms * jnp.exp(-periods * sample.elapsed / TRIAL) + added
    # Once it is too large, it is doubled, so that it takes time to fall.
    begins = (counted >= ALARMS) & (state.alarms < ALARMS)
    for fault in filter(None, faults):
        begins = begins | fault.found
    alarms = jnp.where(begins, 2 * ALARMS, jnp.minimum(counted, 2 * ALARMS))
    # Hypotheses compare the estimates from before and after an alarm; a single filter cannot.
    moves = jnp.where(unlikely, PERSISTENT * periods, 0.0) + (alarm if state.mixture is None else 0.0)
    burst = state.burst * jnp.exp(-periods * sample.elapsed) + moves
    good = (nis < REJECT) & (alarms < ALARMS) & (burst < BURST)
    trusted = jnp.where(good, verdict.theta, state.settled)
    # `settled` is a mean, since the last value may belong to a gust or to a fault before its first alarm.
    kept = alarms < SETTLED
    for fault in filter(None, faults):
        # During a possible exchange or wrong sign, θ may be wrong.
        kept = kept & ~fault.possible
    rate = jnp.where(kept, -jnp.expm1(-periods / TRIAL), 0.0)
    settled = state.settled + rate * (trusted - state.settled)
    return {"nis": nis, "alarms": alarms, "burst": burst, "trusted": trusted, "settled": settled}


def restarted(new: OnlineState, fresh: OnlineState, old: OnlineState, variances: Float[Array, " d"]) -> OnlineState:
    """Return the new state, or restart at the last good θ and the prior covariance if a number is not finite."""
    root = kalman.diagonal_root(variances, jnp.ones_like(old.theta))
    kept = old.trusted, old.trusted, old.settled, root, old.alarms, old.changes, old.restarts + 1
    again = eqx.tree_at(lambda s: (s.theta, s.trusted, s.settled, s.root, s.alarms, s.changes, s.restarts), fresh, kept)
    parts = [new.root, new.x, new.theta, new.nis, new.excitation.sensitivity, new.excitation.root]
    if (mixture := again.mixture) is not None and new.mixture is not None:
        # The filter of all parameters is now used.
        again = eqx.tree_at(lambda s: s.mixture.log_weights, again, mixture.log_weights[::-1])
        parts += [new.mixture.z, new.mixture.root, new.mixture.log_weights]
    total = sum(jnp.sum(jnp.abs(part)) for part in parts)
    return jax.tree.map(lambda a, b: jnp.where(total < HUGE, a, b), new, again)
