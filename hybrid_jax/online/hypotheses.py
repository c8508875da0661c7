"""Hypotheses about a change of a few parameters, as you define them and as `multiple_model` uses them."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from hybrid_jax import checks


@dataclass(frozen=True)
class Hypothesis:
    """A few parameters that may change together, for example with a load.

        Hypothesis("inertia", {"Ix": 0.3, "Iy": 0.3})
        Hypothesis("mass", together=({"efficiency": -0.2, "Ix": -0.2, "Iy": -0.2},))
        Hypothesis("wind", {"disturbance[vx]": 3.0}, rates={"disturbance[vx]": 1.5}, lead=0.1)

    Attributes:
        name: name of the hypothesis in messages.
        parameters: standard deviation of the independent change of each parameter, as physics stores it, by name:
            efficiency[0] is one entry, efficiency a whole array.
        together: shared factors (unit variance) that scale several parameters, for example a mass.
        rates: standard deviation of the rate of change of a parameter in `parameters` [1/s]. The rate is a random walk
            that moves by one standard deviation in half a second.
        lead: how far ahead those parameters are extrapolated in the model [s].

    Raises:
        ValueError: if there is no parameter, a number is out of range, or a rate's parameter is not in `parameters`.
    """

    name: str
    parameters: Mapping[str, float] = field(default_factory=dict)
    together: tuple[Mapping[str, float], ...] = ()
    rates: Mapping[str, float] = field(default_factory=dict)
    lead: float = 0.0

    def __post_init__(self):
        if not self.parameters and not self.together:
            raise ValueError(f"hypothesis {self.name}: parameters must contain at least one")
        for name, size in (*self.parameters.items(), *self.rates.items()):
            checks.positive(f"hypothesis {self.name}: {name}", size)
        if unknown := sorted(self.rates.keys() - self.parameters.keys()):
            raise ValueError(f"hypothesis {self.name}: rates must be of its parameters, got {', '.join(unknown)}")
        checks.not_negative(f"hypothesis {self.name}: lead", self.lead)


class Subspace(NamedTuple):
    """A hypothesis of k numbers a with θ = S a, in prior standard deviations of p parameters."""

    effects: tuple[tuple[float, ...], ...]  # the k rows of Sᵀ
    own: tuple[bool, ...]  # whether each parameter has its own number
    rates: tuple[float, ...]  # standard deviation of each number's rate over the number's [1/s]; 0 for none
    lead: float  # how far ahead the model is extrapolated [s]


class ModelSet(NamedTuple):
    """h hypotheses of k numbers each: first the field's own parameters, then the user's hypotheses."""

    effects: Float[np.ndarray, "h p k"]  # S
    ahead: Float[np.ndarray, "h p k"]  # S of the extrapolated model, including rates
    transition: Float[np.ndarray, "h k k"]  # of the numbers over one period
    prior: Float[np.ndarray, "h k"]  # variances after a change; 0 for padding
    diffusion: Float[np.ndarray, "h k"]  # variance of rates [1/s]
    outside: Float[np.ndarray, "h p"]  # 1 for parameters without their own number, else 0


def subspace_of(hypothesis: Hypothesis, names: tuple[str, ...], scales: tuple[float, ...]) -> Subspace:
    """Express a hypothesis in the order of θ; raise ValueError for an unknown or constant parameter."""
    known = [name for name, scale in zip(names, scales, strict=True) if scale]

    def places(name: str) -> list[int]:
        if not any(name in (each, each.partition("[")[0]) for each in known):
            raise ValueError(f"hypothesis {hypothesis.name}: {name} must be among {', '.join(known)}")
        return [i for i, each in enumerate(names) if scales[i] and name in (each, each.partition("[")[0])]

    def row(sizes: Mapping[int, float]) -> tuple[float, ...]:
        return tuple(sizes.get(i, 0.0) / (scale or 1.0) for i, scale in enumerate(scales))

    alone = [(i, name, size) for name, size in hypothesis.parameters.items() for i in places(name)]
    rates = [hypothesis.rates.get(name, 0.0) / size for _, name, size in alone] + [0.0] * len(hypothesis.together)
    shared = [{i: size for name, size in each.items() for i in places(name)} for each in hypothesis.together]
    rows = [*(row({i: size}) for i, _, size in alone), *map(row, shared)]
    own = tuple(i in {place for place, _, _ in alone} for i in range(len(names)))
    return Subspace(tuple(rows), own, tuple(rates), hypothesis.lead)


def model_set(hypotheses: tuple[Subspace, ...], p: int, dt: float) -> ModelSet:
    """Stack all hypotheses, padded with numbers that have no effect."""
    sizes = [len(hypothesis.effects) + int(np.count_nonzero(hypothesis.rates)) for hypothesis in hypotheses]
    h, k = len(hypotheses) + 1, max(sizes)
    effects, prior, diffusion = np.zeros((h, p, k)), np.zeros((h, k)), np.zeros((h, k))
    ahead, transition = np.zeros((h, p, k)), np.tile(np.eye(k), (h, 1, 1))
    for i, hypothesis in enumerate(hypotheses, 1):
        own = len(hypothesis.effects)
        effects[i, :, :own] = ahead[i, :, :own] = np.transpose(hypothesis.effects)
        prior[i, :own] = 1
        for j, number in enumerate(np.flatnonzero(hypothesis.rates), own):
            rate = hypothesis.rates[number]  # the number at j is in units of it
            transition[i, number, j] = dt * rate
            ahead[i, :, j] = hypothesis.lead * rate * effects[i, :, number]
            prior[i, j], diffusion[i, j] = 1, 2
    outside = np.array([np.ones(p), *(~np.array(hypothesis.own) for hypothesis in hypotheses)], float)
    return ModelSet(effects, ahead, transition, prior, diffusion, outside)
