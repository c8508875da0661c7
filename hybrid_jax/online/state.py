"""The state that an `OnlineAdaptation` carries between samples, and the names of its parameters."""

from collections.abc import Mapping
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from hybrid_jax import checks
from hybrid_jax.dynamics.base import AbstractVectorField
from hybrid_jax.estimation.least_squares import ravel_parameters
from hybrid_jax.estimation.uncertainty import named_parameters
from hybrid_jax.online.change_test import ChangeTest
from hybrid_jax.online.excitation import TAKES_PART, Excitation
from hybrid_jax.online.kalman import Belief
from hybrid_jax.online.multiple_model import Mixture
from hybrid_jax.online.rotor_order import RotorOrder
from hybrid_jax.online.samples import SampleHistory
from hybrid_jax.online.sensor_signs import SensorSigns
from hybrid_jax.online.tuning import ALARMS, BOUND, BURST, FROZEN, REJECT, Tuning

DISTURBANCE = "disturbance"
Numbers = float | tuple[float, ...] | np.ndarray


class OnlineState(eqx.Module):
    """The state of an `OnlineAdaptation` with d states and p parameters; only numbers, so that C can store it.

    Attributes:
        x: the estimated state.
        theta: the change of θ in prior standard deviations, from the filter of all parameters.
        root: a square root of the covariance of both, in these units.
        excitation: information of recent samples about θ.
        test: the change test of the filter of all parameters.
        mixture: the filters of the hypotheses and their weights; None without hypotheses.
        trusted: the last consistent θ, which the model uses.
        settled: their mean over the last 10 s without alarms, restored if alarms or unlikely errors persist.
        alarms: number of alarms in the last 10 s.
        burst: number of unlikely errors in the last second and, without hypotheses, of alarms.
        reset: 1 for each parameter whose variance rises to its prior before the next sample, after an alarm; else 0.
        log_walk: logarithm of the factor on `Tuning.drift` for each parameter, for example for a disturbance in gusts.
        nis: mean normalised innovation squared, 1 if noise and model are correct.
        order: how likely an exchange of two rotors is; None without rotors.
        signs: how likely a wrong sign of a disturbed state is; None if unknown which states are disturbed.
        history: statistics of the past samples.
        changes: number of alarms.
        restarts: number of restarts after a number that was not finite.
    """

    x: Float[Array, "*n d"]
    theta: Float[Array, "*n p"]
    root: Float[Array, "*n d+p d+p"]
    excitation: Excitation
    test: ChangeTest
    mixture: Mixture | None
    trusted: Float[Array, "*n p"]
    settled: Float[Array, "*n p"]
    alarms: Float[Array, "*n"]
    burst: Float[Array, "*n"]
    reset: Float[Array, "*n p"]
    log_walk: Float[Array, "*n p"]
    nis: Float[Array, "*n"]
    order: RotorOrder | None
    signs: SensorSigns | None
    history: SampleHistory
    changes: Float[Array, "*n"]
    restarts: Float[Array, "*n"]

    @property
    def joint(self) -> Belief:
        """The belief about z = [x, θ] of the filter of all parameters."""
        return Belief(jnp.concatenate([self.x, self.theta]), self.root)

    @property
    def covariance(self) -> Float[Array, "*n d+p d+p"]:
        """The covariance of x and θ, in the units of `theta`."""
        return self.root @ self.root.mT


class Flags(NamedTuple):
    """The problems and changes that a filter detected.

    Attributes:
        missing: which states were not measured in the last sample: NaN, or equal to the previous value.
        frozen: which states have a sensor that repeats its last value.
        gap: whether nothing was measured for longer than `Tuning.gap`.
        changed: whether there was an alarm in the last second.
        inconsistent: whether errors are too large for the model at any θ, or alarms persist, for example because a
            sensor has a wrong sign, unit or position, or rotors are exchanged. The earlier estimate is then used.
        exchanged: which rotors seem to be exchanged with another in the input; empty without rotors.
        reversed: which states seem to be measured with the wrong sign, compared with the states whose rate they are.
        unexcited: which parameters recent samples do not excite, by themselves or in combination with others.
        at_bound: which parameters are at the end of their range.
    """

    missing: Bool[Array, " d"]
    frozen: Bool[Array, " d"]
    gap: Bool[Array, ""]
    changed: Bool[Array, ""]
    inconsistent: Bool[Array, ""]
    exchanged: Bool[Array, " m"]
    reversed: Bool[Array, " d"]
    unexcited: Bool[Array, " p"]
    at_bound: Bool[Array, " p"]


def flags_of(state: OnlineState, tuning: Tuning) -> Flags:
    """Evaluate the flags of a state or of stacked states."""
    considered, test = state.excitation.considered(), state.test if state.mixture is None else state.mixture.test
    return Flags(
        missing=state.history.unseen > 0,
        frozen=state.history.equal >= FROZEN,
        gap=state.history.silent > tuning.gap,
        changed=test.quiet < 1,
        inconsistent=(state.nis >= REJECT) | (state.alarms >= ALARMS) | (state.burst >= BURST),
        exchanged=jnp.zeros((*state.nis.shape, 0), bool) if state.order is None else state.order.exchanged,
        reversed=jnp.zeros(state.x.shape, bool) if state.signs is None else state.signs.reversed,
        unexcited=jnp.diagonal(considered, axis1=-2, axis2=-1) > TAKES_PART,
        at_bound=jnp.abs(state.trusted) >= BOUND,
    )


def named_priors(
    field: AbstractVectorField, prior: float | Mapping[str, float], disturbance: Numbers
) -> tuple[tuple[str, ...], tuple[float, ...]]:
    """Return the name and prior standard deviation of each parameter in the order of θ."""
    names = _names(field)
    groups = [name.partition("[")[0] for name in names]
    own = prior if isinstance(prior, Mapping) else dict.fromkeys(groups, prior)
    if unknown := sorted(own.keys() - {*names, *groups}):
        raise ValueError(f"prior: {', '.join(unknown)} must be among {', '.join(dict.fromkeys(groups))}")
    size, sizes = groups.count(DISTURBANCE), np.ravel(disturbance)
    if len(sizes) not in (1, size):
        raise ValueError(f"disturbance must be one number, or {size}, one for each disturbed state, got {len(sizes)}")
    disturbed = iter(np.broadcast_to(sizes, size).tolist())
    found = []
    for name, group in zip(names, groups, strict=True):
        scale = next(disturbed) if group == DISTURBANCE else own.get(name, own.get(group))
        if scale is None:
            raise ValueError(f"prior: {group} must be given, 0 if it should stay constant")
        checks.not_negative(group if group == DISTURBANCE else f"prior of {name}", scale)
        found.append(float(scale))
    if not any(found):
        raise ValueError("prior must be positive for at least one parameter, got 0 for all")
    return names, tuple(found)


def _names(field: AbstractVectorField) -> tuple[str, ...]:
    """Name each parameter; the field may be traced."""
    with jax.ensure_compile_time_eval():
        like = jax.tree.map(lambda a: jnp.zeros(a.shape, jnp.result_type(a)) if eqx.is_inexact_array(a) else a, field)
        theta, unravel = ravel_parameters(like)
        # Each number depends on one parameter.
        slopes = jax.jacfwd(lambda theta: jnp.stack(list(named_parameters(unravel(theta)).values())))(theta)
        labels = list(named_parameters(like))
    return tuple(labels[i] for i in np.argmax(np.abs(np.asarray(slopes)), axis=0))
