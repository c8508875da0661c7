"""What an `OnlineAdaptation` carries from sample to sample, how it is tuned, and what its parameters are called."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from hybrid_jax import checks
from hybrid_jax.adaptation.least_squares import ravel_parameters
from hybrid_jax.adaptation.uncertainty import named_parameters
from hybrid_jax.dynamics.base import AbstractVectorField

DISTURBANCE = "disturbance"
Numbers = float | tuple[float, ...] | np.ndarray


@dataclass(frozen=True)
class Tuning:
    """How fast an `OnlineAdaptation` forgets, and what it calls a change. ValueError for numbers that are negative."""

    drift: float = 0.002  # random walk of a parameter, as a share of its prior standard deviation, 1/√s
    forgetting: float = 30.0  # how much faster a parameter walks for each unit of its squared test beyond `eager`
    eager: float = 6.0  # of a χ² of one degree
    window: float = 0.2  # time constant of the mean NIS [s]
    spans: tuple[float, float] = (0.05, 0.5)  # time constants of the two sums of the test [s]
    alarm: float = 5.0  # of the test, a normal number if nothing has changed
    caution: float = 1.5  # share of what uncertain parameters do to a step that counts as noise, for its nonlinearity
    pause: float = 0.1  # least time between two alarms [s]
    reject: float = 6.0  # mean NIS from which the filter is not believed
    clip: float = 5.0  # standard deviations at which an innovation is cut off, so that an outlier does little
    gap: float = 0.1  # after so long without a sample the state is taken from the next one [s]
    frozen: int = 3  # equal samples in a row from which a sensor counts as frozen
    bound: float = 4.0  # prior standard deviations that a parameter may move

    def __post_init__(self):
        for name in ("drift", "forgetting", "eager", "caution", "pause"):
            checks.not_negative(name, getattr(self, name))
        for name in ("window", "alarm", "reject", "clip", "gap", "bound"):
            checks.positive(name, getattr(self, name))
        checks.count("frozen", self.frozen)


class OnlineState(eqx.Module):
    """State of an `OnlineAdaptation` of d states and p parameters; all of it numbers, which a C program can hold."""

    x: Float[Array, "*n d"]  # estimated state
    theta: Float[Array, "*n p"]  # change of θ in prior standard deviations
    covariance: Float[Array, "*n d+p d+p"]  # of both, in these units
    trusted: Float[Array, "*n p"]  # the last θ that was consistent, which the model has
    free: Float[Array, "*n p"]  # variances that θ would have, had nothing been measured since the last alarm
    pull: Float[Array, "*n 2 p"]  # weighted sums of the corrections of θ, for the test
    spread: Float[Array, "*n 2 p"]  # their variances if nothing has changed
    nis: Float[Array, "*n"]  # mean normalised innovation squared, 1 if noise and model are as stated
    quiet: Float[Array, "*n"]  # time since the last alarm [s]
    silent: Float[Array, "*n"]  # time since something was measured [s]
    last: Float[Array, "*n d"]  # the last sample
    equal: Float[Array, "*n d"]  # how many samples in a row were equal
    unseen: Float[Array, "*n d"]  # 1 where the last sample was not used
    changes: Float[Array, "*n"]  # how many alarms there were
    restarts: Float[Array, "*n"]  # how often the filter had to begin anew, since a number was not finite


class Flags(NamedTuple):
    """What is wrong, or was found."""

    missing: Bool[Array, " d"]  # not measured in the last sample: NaN, or equal to the one before
    frozen: Bool[Array, " d"]  # sensors that repeat their last value
    gap: Bool[Array, ""]  # nothing was measured for longer than `Tuning.gap`
    changed: Bool[Array, ""]  # an alarm in the last second
    inconsistent: Bool[Array, ""]  # errors are too large for the model at any θ: the last good estimate is used
    unexcited: Bool[Array, " p"]  # parameters on which the data say nothing
    at_bound: Bool[Array, " p"]  # parameters at the end of their range


def named_priors(
    field: AbstractVectorField, prior: float | Mapping[str, float], disturbance: Numbers
) -> tuple[tuple[str, ...], tuple[float, ...]]:
    """Name and prior standard deviation of each parameter of the physics, in the order of the vector of all."""
    names = _names(field)
    groups = [name.partition("[")[0] for name in names]
    own = prior if isinstance(prior, Mapping) else dict.fromkeys(groups, prior)
    if unknown := sorted(own.keys() - {*names, *groups}):
        raise ValueError(f"prior: {', '.join(unknown)}: must be among {', '.join(dict.fromkeys(groups))}")
    disturbed = iter(np.broadcast_to(disturbance, groups.count(DISTURBANCE)).tolist())
    found = []
    for name, group in zip(names, groups, strict=True):
        scale = next(disturbed) if group == DISTURBANCE else own.get(name, own.get(group))
        if scale is None:
            raise ValueError(f"prior: {group} must be given")
        checks.positive(group if group == DISTURBANCE else f"prior of {name}", scale)
        found.append(float(scale))
    return names, tuple(found)


def _names(field: AbstractVectorField) -> tuple[str, ...]:
    """The name of each parameter; the field may be traced."""

    def numbers(theta, unravel):
        return jnp.stack(list(named_parameters(unravel(theta)).values()))

    with jax.ensure_compile_time_eval():
        like = jax.tree.map(lambda a: jnp.zeros(a.shape, a.dtype) if eqx.is_inexact_array(a) else a, field)
        theta, unravel = ravel_parameters(like)
        slopes = np.asarray(jax.jacfwd(numbers)(theta, unravel))  # each number depends on one parameter
        labels = list(named_parameters(like))
    return tuple(labels[i] for i in np.argmax(np.abs(slopes), axis=0))
