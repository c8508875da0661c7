"""The result of an adaptation, and its report."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from dataclasses import field as attribute
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Array, Bool, Float, Int

from hybrid_jax.adaptation.evidence import STRONG
from hybrid_jax.adaptation.expectation import Expected, expected_errors, lines_of, longest_chain
from hybrid_jax.adaptation.plausible import CANDIDATES, WORDS
from hybrid_jax.adaptation.selection import blocks_of, variance_if_free
from hybrid_jax.dynamics.base import AbstractVectorField
from hybrid_jax.estimation.normal_equations import NormalEquations, masked
from hybrid_jax.estimation.uncertainty import sandwich
from hybrid_jax.io.files import json_value
from hybrid_jax.state_space import StateSpace
from hybrid_jax.status import Status
from hybrid_jax.trajectories import WARN, Trajectories

NETWORK = "network"  # the candidate that changes the network
SHOWN = 0.01  # less probable candidates are not reported
NOT_CONFIRMED = "errors in windows that were left out of the fit do not confirm it"
AS_LARGE = "the source's own errors may be as large without any change"
UNLIKE = ", as these windows are unlike its training data"


class Choice(NamedTuple):
    """The c candidates and the chosen one, with the p parameters of the extended physics, see `extended`."""

    names: tuple[str, ...]  # of the candidates
    probability: Float[Array, " c"]  # of each change; the network's is relative to the one chosen before it
    rejected: Bool[Array, " c"]  # which would be more probable than the chosen one if the source had no errors
    taken: Int[Array, ""]  # index of the chosen candidate
    alone: Bool[Array, ""]  # whether physics without the network replaced the source
    parameters: tuple[str, ...]  # names of the parameters
    free: Bool[Array, "c p"]  # which parameters each candidate fitted
    kept: Bool[Array, " p"]  # which of θ_p the chosen one kept, see `kept_parameters`
    theta: Float[Array, "c p"]  # in the physics' own parametrisation, to first order unless chosen
    equations: NormalEquations  # of each window, for all parameters, at the chosen ones
    change: Float[Array, "c w"] | None  # of the network's weights; None without a trainable network
    ends: Float[Array, "b 2 d"]  # errors of left-out blocks or flights, see `errors_at_ends`
    inherited: Float[Array, "p p"]  # covariance due to errors of the parameters that the source keeps
    degrees: Float[Array, ""]  # degrees of freedom of `inherited`
    absorbed: Float[Array, " p"]  # variance of what the network may have absorbed, see `taken_by_network`
    vague: Bool[Array, " p"]  # rigid bodies only: whether that is a large part of a plausible change
    usual: Float[Array, "r 2 d"] | None = None  # the source's errors on parts of its own flights, if these are known

    def covariance(self, cluster: int) -> Float[np.ndarray, "p p"]:
        """Return the covariance of the fitted parameters and, for kept ones, their `variance_if_free`.

        It is infinite for parameters that the windows do not determine; for `cluster` see `covariance_of`.
        """
        fitted = np.asarray(self.free)[self.taken]
        unseen = fitted & (np.asarray(self.equations.score) == 0).all(axis=0)
        found = sandwich(masked(self.equations, fitted), int(fitted.sum()), cluster)
        away = variance_if_free(self.equations, fitted | self.kept, cluster)
        return np.asarray(found) + np.diag(np.where(unseen, np.inf, np.where(self.kept, away, 0.0)))

    def expected(
        self, windows: Trajectories, space: StateSpace, flights: Int[np.ndarray, " n"] | None = None
    ) -> Expected:
        """Return the errors to expect on another flight, see `expected_errors`."""
        seconds, ends = windows.horizon * windows.dt, np.asarray(self.ends)
        chain = seconds * longest_chain(windows, blocks_of(len(windows), len(ends), flights))
        usual = None if self.usual is None else np.asarray(self.usual)
        if usual is not None and (self.names[int(self.taken)] == NETWORK or not np.isfinite(usual).all()):
            usual = None  # the source's errors tell nothing of another network
        return expected_errors(ends, (round(seconds, 9), round(chain, 9)), space, flights is not None, usual)


@dataclass(frozen=True)
class Parameter:
    """A physical parameter and its confidence interval.

    Attributes:
        value: the estimate, in `unit`. If no change of the parameter was found, it is the source's value, and the
            interval says what the windows do not exclude.
        low: lower end of the interval in `unit`: NaN without a valid one, −∞ or 0 if the parameter is not identifiable.
        high: upper end in `unit`: NaN without a valid interval, ∞ if the parameter is not identifiable.
        unit: the unit, for example "kg m²"; None if unknown.
        effective: why the value predicts well but need not be the system's own, so that it has no interval; None if it
            is physical.
        before: the source's value, in `unit`; NaN if it has none.
        change: the interval of `value` − `before`, in `unit`; NaN without a valid one. It is often narrower than that
            of the value, because the network is the same before and after: what it learned instead of physics cancels,
            unless that scales with a parameter that changed.
    """

    value: float
    low: float = math.nan
    high: float = math.nan
    unit: str | None = None
    effective: str | None = None
    before: float = math.nan
    change: tuple[float, float] = (math.nan, math.nan)

    @property
    def has_interval(self) -> bool:
        """Whether the parameter has a valid interval, which may be infinite."""
        return not math.isnan(self.low)

    def __str__(self) -> str:
        around = " (effective)" if self.effective else ""
        around = f" ({self.low:.4g} to {self.high:.4g})" if self.has_interval else around
        return f"{self.value:.4g}{f' {self.unit}' if self.unit else ''}{around}"


@dataclass(frozen=True, eq=False)
class Adaptation:
    """An adapted field with its parameters, their intervals and its expected errors.

    Attributes:
        field: the adapted field.
        method: name of the method, or its class if you passed a value.
        parameters: parameters of physics and disturbance, by the names of `uncertainty.named_parameters`.
        disturbance: the constant part of ẋ in the units of ẋ; None if there is none.
        mse_before: L_MSE of the source field on the windows, in squared units of the states.
        mse_after: L_MSE of the adapted field on the windows, in the same units.
        windows: the number of windows that were used.
        steps: number of epochs, or of evaluations of the Jacobian; 0 for a closed form.
        status: how the method ended.
        level: confidence level of the intervals, between 0 and 1.
        without_intervals: why there are no intervals; None if there are.
        covariance: covariance in the physics' own parametrisation, of effective parameters too; None without intervals.
        degrees: effective degrees of freedom of each variance, see `pooling.satterthwaite`; ∞ for the normal
            distribution; None without intervals.
        absorbed: the part of each variance due to what the network may have taken; None without intervals.
        changed: parameters that differ significantly from the source's, the most significant first.
        set_aside: number of samples with outliers, which count as not measured, or whose window begins with one.
        not_measured: share of the states of the windows, 0 to 1, that are NaN, which counts as not measured.
        candidates: "auto" only: probability of each change by name, 0 to 1; the network's is relative to `chosen`.
        chosen: "auto" only: name of the chosen candidate.
        rejected: "auto" only: candidates that would be more probable than the chosen one if the source had no errors.
        physics_only: "auto" only: whether physics, fitted to the source's own motion, replaced physics and network.
        expected: "auto" only: errors on an unseen flight, by horizon and quantity: value, low, high.
        units: units of the quantities in `expected`.
        outside: share of samples, 0 to 1, outside the range of the source's training data, by quantity.
    """

    field: AbstractVectorField
    method: str
    parameters: dict[str, Parameter]
    disturbance: Float[np.ndarray, " d"] | None
    mse_before: float
    mse_after: float
    windows: int
    steps: int
    status: Status
    level: float
    without_intervals: str | None
    covariance: Float[np.ndarray, "p p"] | None = None
    degrees: Float[np.ndarray, " p"] | None = None
    absorbed: Float[np.ndarray, " p"] | None = None
    changed: tuple[str, ...] = ()
    set_aside: int = 0
    not_measured: float = 0.0
    candidates: dict[str, float] = attribute(default_factory=dict)
    chosen: str | None = None
    rejected: tuple[str, ...] = ()
    physics_only: bool = False
    expected: Expected = attribute(default_factory=dict)
    units: dict[str, str] = attribute(default_factory=dict)
    outside: dict[str, float] = attribute(default_factory=dict)

    @property
    def converged(self) -> bool:
        """Whether the method stopped by itself, at a finite error."""
        return self.status == Status.OK

    def report(self) -> str:
        """Return a summary in plain text, a few lines."""
        return "\n".join([*self._about_the_fit(), *self._about_parameters()])

    def _about_the_fit(self) -> Iterator[str]:
        after = f" after {self.steps} steps" if self.steps else ""
        yield f"Adapted to {self.windows} windows by {self.method}: {self.status.message}{after}."
        if self.set_aside:
            yield f"Set aside: {self.set_aside} samples with outliers."
        if self.not_measured:
            yield f"Not measured: {self.not_measured:.1%} of the states, which are NaN; they count as no error."
        yield f"Mean squared prediction error: {self.mse_before:.3g} before, {self.mse_after:.3g} after."
        if self.chosen is not None:
            known = dict(sorted(self.candidates.items(), key=lambda one: -one[1]))
            rather = known.pop(NETWORK, None)
            found = ", ".join(f"{name} {share:.2g}" for name, share in known.items() if share >= SHOWN)
            yield f"Chosen: {self.chosen}, that is, {_in_words(self.chosen)}. Probability of each change: {found}."
            if self.chosen == NETWORK:
                yield f"Probability that the network changed, rather than the most probable of these: {rather:.2g}."
            # If the evidence of the most probable change is strong, left-out windows rejected it.
            likely = next(iter(known))
            strong = known[likely] > STRONG * known.get("source", 1.0)
            as_large = AS_LARGE + UNLIKE * any(share > WARN for share in self.outside.values())
            for reason, sure in ((NOT_CONFIRMED, True), (as_large, False)):
                if names := [name for name in self.rejected if (strong and name == likely) == sure]:
                    yield f"Rejected: {', '.join(names)}: {reason}."
        if self.physics_only:
            yield "Physics without the network predicts the source's own motion better and replaces the source."
        if self.expected:
            yield "RMSE to expect on a new recording (80% intervals, from blocks of windows that were left out):"
            yield from lines_of(self.expected, self.units)
        yield from lines_outside(self.outside)

    def _about_parameters(self) -> Iterator[str]:
        if self.parameters:
            note = f"{self.level:.0%} confidence intervals" if self.without_intervals is None else "no intervals"
            width = max(map(len, self.parameters))
            yield f"Parameters ({note}):"
            for name, one in self.parameters.items():
                before = f", before {one.before:.4g}" if abs(one.value - one.before) > 0 else ""
                change = ", change {:.3g} to {:.3g}".format(*one.change) if np.isfinite(one.change).all() else ""
                yield f"  {name:<{width}}  {one}{before}{change}"
            if self.changed:
                yield f"Significantly different from the source: {_listed(self.changed)}."
            effective = [name for name, one in self.parameters.items() if one.effective]
            kept = [name for name, one in self.parameters.items() if one.value == one.before]
            if kept and self.chosen is not None:
                yield f"Kept as before: {'all parameters' if len(kept) == len(self.parameters) else _listed(kept)}."
            for reason in dict.fromkeys(self.parameters[name].effective for name in effective):
                names = _listed([name for name in effective if self.parameters[name].effective == reason])
                yield f"Effective, so without an interval: {names}: {reason}."
            if unseen := [name for name, one in self.parameters.items() if one.high == np.inf]:
                yield f"Warning: these windows do not determine {_listed(unseen)}: other values fit them as well."
                yield "If these may have changed, hj.excitation plans an experiment that determines them."
        yield f"Constant disturbance: {'none' if self.disturbance is None else 'see parameters'}."
        if self.parameters and self.without_intervals is not None:
            yield f"No intervals: {self.without_intervals}."

    def to_dict(self) -> dict[str, Any]:
        """Return all attributes but the field as JSON values; numbers that are not finite become None."""
        parameters = {name: asdict(parameter) for name, parameter in self.parameters.items()}
        found = vars(self) | {"status": str(self.status), "converged": self.converged, "parameters": parameters}
        return json_value({name: value for name, value in found.items() if name != "field"})


def lines_outside(outside: Mapping[str, float]) -> Iterator[str]:
    """Yield a warning for each quantity that is often outside the source's training range."""
    for name, share in outside.items():
        if share > WARN:
            yield f"Warning: {name} is outside the source's training range in {share:.0%} of the samples."


def _in_words(candidate: str) -> str:
    if candidate == NETWORK:
        return "new weights of the network"
    *first, last = (WORDS[each] for each in CANDIDATES[candidate] or ["source"])
    return f"{', '.join(first)} and {last}" if first else last


def _listed(names: Sequence[str]) -> str:
    """Join names of parameters; of an array's, if they are more than two, give only the number."""
    arrays: dict[str, list[str]] = {}
    for name in names:
        arrays.setdefault(name.partition("[")[0], []).append(name)
    return ", ".join(
        f"{array} ({len(own)} numbers)" if len(own) > 2 else ", ".join(own) for array, own in arrays.items()
    )
