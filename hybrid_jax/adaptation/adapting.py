"""`adapt`: adapt any field to windows of a changed system, with any method and one type of result."""

import math
import warnings
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from dataclasses import field as attribute
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from hybrid_jax import checks
from hybrid_jax.adaptation import ridge
from hybrid_jax.adaptation.auto import NETWORK, Auto, Choice, has_network
from hybrid_jax.adaptation.expectation import Expected, expected_errors, lines_of
from hybrid_jax.adaptation.methods import FineTune, LeastSquares, Method, Ridge, Solution, Source, scale_of
from hybrid_jax.adaptation.selection import correlated, longest_chain, overlap
from hybrid_jax.dynamics.base import AbstractVectorField, check_windows, state_space, trainable
from hybrid_jax.dynamics.disturbance import (
    disturbance_of,
    disturbance_units,
    physics_of,
    without_disturbance,
    without_zeros,
)
from hybrid_jax.dynamics.rigid_body import uncorrected
from hybrid_jax.estimation.uncertainty import check_level, covariance_of, intervals, named_parameters, sandwich
from hybrid_jax.extrapolation import WARN, features_of, shares_outside
from hybrid_jax.integrate import checked, compact
from hybrid_jax.io.files import json_value
from hybrid_jax.io.models import check_savable
from hybrid_jax.metrics import rollout_mse
from hybrid_jax.networks.standardise import motion_of
from hybrid_jax.runtime import FAST_COMPILE, entry, jit_by_size, keep_programs, load_lapack
from hybrid_jax.state_space import StateSpace
from hybrid_jax.status import Status
from hybrid_jax.training.channels import scaled_loss
from hybrid_jax.training.objective import Settings
from hybrid_jax.trajectories import Trajectories, check_like, overflows

HELD_OUT = 5  # one in so many windows validates
SHOWN = 0.01  # less probable candidates are not reported
NAMED = 50  # physics with more parameters is a network, and its weights are not listed
NOT_LEAST_SQUARES = "they are valid for least squares only, where no network is trained on the same windows"
NOT_FINITE = "the fit diverged; check dt and all units"
NOT_FITTED = "no parameter was fitted"
NO_MOTION = "field: its training windows are unknown, so all its errors count as changes; pass learned_from="
FEW = "windows: {} do not determine {} parameters; the others stay at the source's values"
OVERLAP = "windows overlap: left-out blocks share samples with the others, so the expected errors are too small"

METHODS: Mapping[str, Method] = {
    "auto": Auto(),
    "least_squares": LeastSquares(),
    "theta_least_squares": LeastSquares(disturbance=False),
    "fine_tune": FineTune(),
    "theta_only": FineTune(frozen="residual"),
    "residual_only": FineTune(frozen="physics"),
    "last_layer": Ridge(ridge.last_layer),
    "linear_residual": Ridge(ridge.linear_residual),
    "source": Source(),
}


@dataclass(frozen=True)
class Parameter:
    """A physical parameter and its confidence interval.

    Attributes:
        value: the estimate, in `unit`.
        low: lower end of the interval in `unit`: NaN without a valid one, −∞ or 0 if the parameter is not identifiable.
        high: upper end in `unit`: NaN without a valid interval, ∞ if the parameter is not identifiable.
        unit: for example "kg m²"; None if unknown.
    """

    value: float
    low: float = math.nan
    high: float = math.nan
    unit: str | None = None

    @property
    def has_interval(self) -> bool:
        """Whether there is a valid interval, which may be infinite."""
        return not math.isnan(self.low)

    def __str__(self) -> str:
        around = f"  ({self.low:.4g} to {self.high:.4g})" if self.has_interval else ""
        return f"{self.value:.4g}{f' {self.unit}' if self.unit else ''}{around}"


@dataclass(frozen=True, eq=False)
class Adaptation:
    """An adapted field with its parameters, their intervals and its expected errors.

    Attributes:
        field: the adapted field.
        method: name of the method, or its class if you passed a value.
        parameters: of physics and disturbance, by the names of `uncertainty.named_parameters`.
        disturbance: the constant part of ẋ in the units of ẋ; None if there is none.
        mse_before: L_MSE of the source field on all windows, in squared units of the states.
        mse_after: L_MSE of the adapted field on all windows, in the same units.
        windows: the number of windows.
        steps: epochs, or evaluations of the Jacobian; 0 for a closed form.
        status: how the method ended.
        level: confidence level of the intervals, between 0 and 1.
        without_intervals: why there are no intervals; None if there are.
        covariance: covariance in the physics' own parametrisation; None without intervals.
        degrees: degrees of freedom of the covariance, one less than the clusters of adjacent windows, or None.
        candidates: "auto" only: probability of each change by name, 0 to 1; the network's is relative to the one taken.
        chosen: "auto" only: name of the chosen candidate.
        refused: "auto" only: candidates that would be more probable than the chosen one if the source had no errors.
        alone: "auto" only: whether physics, fitted to the source's own motion, replaced physics and network.
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
    degrees: int | None = None
    candidates: dict[str, float] = attribute(default_factory=dict)
    chosen: str | None = None
    refused: tuple[str, ...] = ()
    alone: bool = False
    expected: Expected = attribute(default_factory=dict)
    units: dict[str, str] = attribute(default_factory=dict)
    outside: dict[str, float] = attribute(default_factory=dict)

    @property
    def converged(self) -> bool:
        """Whether the method stopped by itself, at a finite error."""
        return self.status == Status.OK

    def report(self) -> str:
        """A summary in plain text, a few lines."""
        after = f" after {self.steps} steps" if self.steps else ""
        lines = [
            f"Adapted to {self.windows} windows by {self.method}: {self.status.message}{after}.",
            f"Mean squared prediction error: {self.mse_before:.3g} before, {self.mse_after:.3g} after.",
        ]
        if self.chosen is not None:
            known = sorted(self.candidates.items(), key=lambda one: -one[1])
            found = ", ".join(f"{name} {share:.2g}" for name, share in known if share >= SHOWN)
            lines.append(f"Chosen: {self.chosen}. Probability of each change: {found}.")
        if self.alone:
            lines.append("Physics without the network predicts the source's own motion better and replaces the source.")
        if self.refused:
            names = ", ".join(self.refused)
            lines.append(f"Refused: {names}: the source's own errors may be as large without any change.")
        if self.expected:
            lines.append("Expected RMSE on an unseen flight (80% intervals, from left-out blocks of these windows):")
            lines += lines_of(self.expected, self.units)
        for name, share in self.outside.items():
            if share > WARN:
                lines.append(f"Warning: {name} is outside the source's training range in {share:.0%} of the samples.")
        if self.parameters:
            note = f"{self.level:.0%} confidence intervals" if self.without_intervals is None else "no intervals"
            width = max(map(len, self.parameters))
            lines.append(f"Parameters ({note}):")
            lines += [f"  {name:<{width}}  {parameter}" for name, parameter in self.parameters.items()]
            told = [name for name, one in self.parameters.items() if one.has_interval and one.high < np.inf]
            rest = [name for name in self.parameters if name not in told]
            if rest and self.chosen is not None:
                names = f"{', '.join(told) or 'no parameter'}, and not {', '.join(rest)}"
                lines.append(f"These windows identify {names}; hj.excitation plans a flight for all of them.")
            if unseen := [name for name, one in self.parameters.items() if one.high == np.inf]:
                names = ", ".join(unseen)
                lines.append(f"Warning: these windows do not determine {names}: other values fit them as well.")
        lines.append(f"Constant disturbance: {'none' if self.disturbance is None else 'see parameters'}.")
        if self.parameters and self.without_intervals is not None:
            lines.append(f"No intervals: {self.without_intervals}.")
        return "\n".join(lines)

    def to_dict(self) -> dict[str, Any]:
        """All but the field as JSON values; numbers that are not finite become None."""
        parameters = {name: asdict(parameter) for name, parameter in self.parameters.items()}
        found = vars(self) | {"status": str(self.status), "converged": self.converged, "parameters": parameters}
        return json_value({name: value for name, value in found.items() if name != "field"})


@entry
def adapt(
    field: AbstractVectorField,
    windows: Trajectories,
    *,
    method: str | Method = "auto",
    validation: Trajectories | None = None,
    learned_from: Trajectories | None = None,
    settings: Settings | None = None,
    level: float = 0.95,
) -> Adaptation:
    """Adapt a source field to windows of a changed system.

    Args:
        field: a trained `Hybrid`, or any other field.
        windows: in the order of time and without overlap. Least squares needs more windows than parameters. If the
            windows follow each other, for example in one flight, the intervals allow for errors that are correlated
            within a fifth of the windows.
        method: a name in `METHODS`, or a value such as `FineTune(seed=1)`; see `Method` to write your own.
        validation: windows for early stopping and penalties. By default the last fifth of `windows` is held out if
            the method needs validation.
        learned_from: windows that the source was trained on, by default those that `hj.fit` stores in its networks.
            "auto" uses them to estimate the source's own error, and the report warns if `windows` are unlike them.
        settings: by default RK4, minibatches of at most 100, and the objective `scaled_loss(field, windows)`, which is
            independent of units. If you pass settings, their objective is used, by default the plain MSE.
        level: confidence level of the intervals.

    Raises:
        ValueError: an unknown method, malformed, too few or other windows, or a field that the method cannot adapt.
    """
    checks.not_traced("adapt", field, windows, validation, learned_from)
    name, method = _named(method)
    windows = check_windows(field, windows)
    learned_from = motion_of(field) if learned_from is None else learned_from
    if learned_from is not None:
        learned_from = check_windows(field, learned_from, "learned_from")
        check_like(learned_from, windows, "learned_from", dt=False)
    check_level(level)
    train, held_out = _split(windows, validation, getattr(method, "uses_validation", True))
    held_out = check_windows(field, held_out, "validation")
    check_like(held_out, train, "validation")
    settings = Settings(objective=scaled_loss(field, train)) if settings is None else settings
    checks.instance("settings", settings, Settings)
    for data in (windows,) if validation is None else (windows, validation):
        checked(field, data.x0[0], data.u[0], data.dt, settings.solver)
    exact, size = getattr(method, "has_intervals", False), _size(field)
    if exact and size > NAMED:
        physics = type(physics_of(field)).__name__
        raise ValueError(f"field: {physics} has {size} parameters, no named physics to fit; use method='fine_tune'")
    if (reason := check_savable(field)) is not None:
        warnings.warn(reason, stacklevel=3)
    if overlap(windows):
        warnings.warn(OVERLAP, stacklevel=3)
    motion = {"learned_from": learned_from} if getattr(method, "uses_motion", False) else {}
    if motion and learned_from is None and has_network(field):
        warnings.warn(NO_MOTION, stacklevel=3)
    if motion and len(windows) <= size:
        warnings.warn(FEW.format(len(windows), size), stacklevel=3)
    load_lapack()
    keep_programs("adapt", windows.x.shape)
    diverged = Solution(field, status=Status.DIVERGED) if overflows(windows) or overflows(held_out) else None
    solution = diverged or method.solve(field, train, held_out, settings, **motion)
    if not isinstance(solution, Solution):
        raise ValueError(f"method: {name}.solve must return a Solution, got {type(solution).__name__}")
    mse = partial(_mse, solver=compact(settings.solver))
    before = mse(field, windows)  # its program is read, and SciPy's functions imported, while the device solves
    import scipy.special  # noqa: F401

    adapted = solution.field
    if disturbance_of(field) is None:
        adapted = uncorrected(without_zeros(adapted))  # what windows need
    space = state_space(field, windows.x0.shape[-1])
    choice = {} if solution.choice is None else _chosen(solution.choice, train, space)
    status = Status(int(solution.status))
    without = None if exact and choice.get("chosen") != NETWORK else NOT_LEAST_SQUARES
    without = NOT_FINITE if status == Status.DIVERGED else without
    found = disturbance_of(adapted)
    return Adaptation(
        field=adapted,
        method=name,
        disturbance=None if found is None else np.asarray(found.vector(windows.x0.shape[-1])),
        mse_before=float(before),
        mse_after=float(mse(adapted, windows)),
        windows=len(windows),
        steps=int(solution.steps),
        status=status,
        level=level,
        outside={}
        if learned_from is None
        else shares_outside(*(features_of(w, space) for w in (learned_from, windows))),
        **choice,
        **_parameters(adapted, train, settings, level, without, solution.choice),
    )


_mse = jit_by_size(FAST_COMPILE)(rollout_mse)


def _chosen(choice: Choice, windows: Trajectories, space: StateSpace) -> dict[str, Any]:
    seconds = windows.horizon * windows.dt
    chain = seconds * longest_chain(windows, len(choice.ends))
    return {
        "candidates": dict(zip(choice.names, np.asarray(choice.probability).tolist(), strict=True)),
        "chosen": choice.names[int(choice.taken)],
        "alone": bool(choice.alone),
        "refused": tuple(name for name, one in zip(choice.names, np.asarray(choice.refused), strict=True) if one),
        "expected": expected_errors(np.asarray(choice.ends), (round(seconds, 9), round(chain, 9)), space),
        "units": {one.name: one.unit for one in space.quantities},
    }


def _named(method: str | Method) -> tuple[str, Method]:
    if isinstance(method, str):
        if method not in METHODS:
            raise ValueError(f"method must be one of {', '.join(METHODS)}, or a value, got {method!r}")
        return method, METHODS[method]
    if isinstance(method, type) or not callable(getattr(method, "solve", None)):
        raise ValueError(f"method must have a method solve, see Method, got {checks.short_repr(method)}")
    return type(method).__name__, method


def _split(windows: Trajectories, validation: Trajectories | None, needed: bool) -> tuple[Trajectories, Trajectories]:
    """Split into training and validation windows; both are all windows if no validation is needed."""
    if validation is not None or not needed:
        return windows, windows if validation is None else validation
    if len(windows) < 2:
        raise ValueError("windows must be at least two to hold one out, got 1; pass validation=")
    last = len(windows) - max(1, len(windows) // HELD_OUT)
    return windows[:last], windows[last:]


def _size(field: AbstractVectorField) -> int:
    physics = physics_of(without_disturbance(field))
    return sum(leaf.size for leaf in jax.tree.leaves(eqx.filter(physics, trainable(physics))))


def _parameters(
    field: AbstractVectorField,
    windows: Trajectories,
    settings: Settings,
    level: float,
    without: str | None,
    choice: Choice | None,
) -> dict[str, Any]:
    if not 0 < _size(field) <= NAMED:
        return {"parameters": {}, "without_intervals": NOT_LEAST_SQUARES}
    own = physics_of(without_disturbance(field))
    known = (own.parameter_units if isinstance(own, AbstractVectorField) else {}) | disturbance_units(field)
    values = named_parameters(field)
    units = {name: known.get(name, known.get(name.split("[")[0])) or None for name in values}
    alone = {name: Parameter(float(value), unit=units[name]) for name, value in values.items()}
    free = np.ones(len(values), bool)
    if choice is not None:
        places = [choice.parameters.index(name) for name in values]
        free = np.asarray(choice.free)[choice.taken][places]
    if without is None and not free.any():
        without = NOT_FITTED
    if without is None and len(windows) <= free.sum():
        without = FEW.format(len(windows), free.sum())
    if without is not None:
        return {"parameters": alone, "without_intervals": without}
    cluster = correlated(windows)
    degrees = None if cluster == 1 else -(-len(windows) // cluster) - 1
    if choice is None:
        scale = scale_of(settings.objective, windows.x0.shape[-1])
        covariance = np.asarray(covariance_of(field, windows, solver=settings.solver, scale=scale, cluster=cluster))
    else:
        unseen = free & (np.asarray(choice.equations.score) == 0).all(axis=0)[places]
        covariance = np.asarray(sandwich(choice.equations, int(free.sum()), cluster))[np.ix_(places, places)]
        covariance = covariance + np.diag(np.where(unseen, np.inf, 0.0))
    if np.isnan(covariance).any():
        return {"parameters": alone, "without_intervals": NOT_FINITE}
    found = intervals(field, jnp.asarray(covariance), level, degrees)
    bounded = {
        name: Parameter(*map(float, found[name]), unit=units[name])
        for name, one in zip(values, free, strict=True)
        if one
    }
    return {"parameters": alone | bounded, "without_intervals": None, "covariance": covariance, "degrees": degrees}
