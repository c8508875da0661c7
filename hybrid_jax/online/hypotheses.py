"""Causes: the few parameters that change together, as named by a user and as the filters of `causes_bank` have them."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from hybrid_jax import checks


@dataclass(frozen=True)
class Cause:
    """A few parameters that may change together, such as those of a load.

        Cause("inertia", {"Ix": 0.3, "Iy": 0.3})
        Cause("mass", together=({"efficiency": -0.2, "Ix": -0.2, "Iy": -0.2},))
        Cause("wind", {"disturbance[vx]": 3.0, "disturbance[vy]": 3.0}, rates={"disturbance[vx]": 1.5}, lead=0.1)

    Attributes:
        name: of the cause, in messages.
        parameters: standard deviation of the change of each, independent of the others, in the physics' own
            parametrisation; by name, of one entry, efficiency[0], or of all of an array, efficiency.
        together: each a number of standard deviation one, times which several parameters change, such as a mass.
        rates: standard deviation of the rate at which a parameter of `parameters` goes on changing [1/s]. The rate is
            a random walk, which moves by as much in half a second.
        lead: how far ahead the delivered model has those parameters [s].

    Raises:
        ValueError: no parameter, a deviation or a lead out of range, or a rate of a parameter that it does not have.
    """

    name: str
    parameters: Mapping[str, float] = field(default_factory=dict)
    together: tuple[Mapping[str, float], ...] = ()
    rates: Mapping[str, float] = field(default_factory=dict)
    lead: float = 0.0

    def __post_init__(self):
        if not self.parameters and not self.together:
            raise ValueError(f"cause {self.name}: it must have a parameter")
        for name, size in (*self.parameters.items(), *self.rates.items()):
            checks.positive(f"cause {self.name}: {name}", size)
        if unknown := sorted(self.rates.keys() - self.parameters.keys()):
            raise ValueError(f"cause {self.name}: rates of {', '.join(unknown)}, which are not among its parameters")
        checks.not_negative(f"cause {self.name}: lead", self.lead)


@dataclass(frozen=True)
class Directions:
    """A cause in the order of θ, of p parameters in their prior standard deviations: numbers a of which θ = S a."""

    name: str
    effects: tuple[tuple[float, ...], ...]  # k rows, of Sᵀ
    own: tuple[bool, ...]  # whether it has a number for a parameter alone
    rates: tuple[float, ...]  # of each number, the deviation of its rate over its own; 0 for none
    lead: float


class Bank(NamedTuple):
    """h hypotheses of as many numbers each: the parameters are the field's own, then the causes."""

    effects: Float[np.ndarray, "h p k"]  # S
    ahead: Float[np.ndarray, "h p k"]  # S of the delivered model, which knows rates
    turned: Float[np.ndarray, "h k k"]  # the numbers of the next period by those of this
    prior: Float[np.ndarray, "h k"]  # variances after a change; 0 for numbers that only fill up
    walked: Float[np.ndarray, "h k"]  # variance per second of rates
    untold: Float[np.ndarray, "h p"]  # 1 for parameters that have no number of their own, else 0


def directions(cause: Cause, names: tuple[str, ...], scales: tuple[float, ...]) -> Directions:
    """The cause among parameters of these names and prior standard deviations.

    Raises:
        ValueError: a name that is unknown, or of a parameter that is held, with a prior of zero.
    """
    names, rows, rates = tuple(name if scale else "" for name, scale in zip(names, scales, strict=True)), [], []
    for name, size in cause.parameters.items():
        for i in _places(cause, name, names):
            rows.append(_row({i: size}, scales))
            rates.append(cause.rates.get(name, 0.0) / size)
    own = np.any(rows, axis=0) if rows else np.zeros(len(names), bool)
    for mapping in cause.together:
        sizes = {i: size for name, size in mapping.items() for i in _places(cause, name, names)}
        rows.append(_row(sizes, scales))
        rates.append(0.0)
    return Directions(cause.name, tuple(rows), tuple(own.tolist()), tuple(rates), cause.lead)


def _places(cause: Cause, name: str, names: tuple[str, ...]) -> list[int]:
    """Where a parameter, or the entries of an array, stand in θ."""
    found = [i for i, each in enumerate(names) if name in (each, each.partition("[")[0])]
    if not found:
        raise ValueError(f"cause {cause.name}: {name} must be among {', '.join(filter(None, names))}")
    return found


def _row(sizes: Mapping[int, float], scales: tuple[float, ...]) -> tuple[float, ...]:
    return tuple(sizes.get(i, 0.0) / (scale or 1.0) for i, scale in enumerate(scales))


def bank_of(causes: tuple[Directions, ...], p: int, dt: float) -> Bank:
    """Arrays of all hypotheses, filled up with numbers that move nothing."""
    sizes = [len(cause.effects) + int(np.count_nonzero(cause.rates)) for cause in causes]
    h, k = len(causes) + 1, max(sizes)
    effects, prior, walked = np.zeros((h, p, k)), np.zeros((h, k)), np.zeros((h, k))
    ahead, turned = np.zeros((h, p, k)), np.tile(np.eye(k), (h, 1, 1))
    for i, cause in enumerate(causes, 1):
        own = len(cause.effects)
        effects[i, :, :own] = ahead[i, :, :own] = np.transpose(cause.effects)
        prior[i, :own] = 1
        for j, number in enumerate(np.flatnonzero(cause.rates), own):
            rate = cause.rates[number]  # the number at j is in units of it
            turned[i, number, j] = dt * rate
            ahead[i, :, j] = cause.lead * rate * effects[i, :, number]
            prior[i, j], walked[i, j] = 1, 2
    untold = np.array([np.ones(p), *(~np.array(cause.own) for cause in causes)], float)
    return Bank(effects, ahead, turned, prior, walked, untold)
