"""`adapt`: adapt any field to windows of a changed system, with any method and one type of result."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, overload

import numpy as np

from hybrid_jax import checks
from hybrid_jax.adaptation import ridge
from hybrid_jax.adaptation.anchored import has_network
from hybrid_jax.adaptation.auto import Auto
from hybrid_jax.adaptation.methods import FineTune, LeastSquares, Method, Ridge, Solution, Source
from hybrid_jax.adaptation.outliers import without_outliers
from hybrid_jax.adaptation.parameters import FEW, NOT_FINITE, NOT_LEAST_SQUARES, parameters_of, size_of
from hybrid_jax.adaptation.records import RecordAdaptation, adapt_records
from hybrid_jax.adaptation.results import Adaptation, Choice
from hybrid_jax.adaptation.selection import overlap
from hybrid_jax.dynamics import disturbance
from hybrid_jax.dynamics.base import AbstractVectorField, state_space
from hybrid_jax.dynamics.disturbance import ConstantDisturbance, disturbance_of, physics_of
from hybrid_jax.dynamics.outputs import StateSpaceModel
from hybrid_jax.dynamics.rigid_body import uncorrected
from hybrid_jax.dynamics.window_checks import check_windows
from hybrid_jax.estimation.discretisation import NAMED, compare_steps
from hybrid_jax.estimation.record_fit import RecordFit
from hybrid_jax.estimation.uncertainty import check_level
from hybrid_jax.implicit_solvers import solver_errors
from hybrid_jax.integrate import checked, compact
from hybrid_jax.io.models import check_savable
from hybrid_jax.metrics import errors_in
from hybrid_jax.networks.standardise import motion_of
from hybrid_jax.records import Record
from hybrid_jax.runtime import UNOPTIMISED, entry, jit_with, keep_programs, load_lapack
from hybrid_jax.state_space import StateSpace
from hybrid_jax.status import Status
from hybrid_jax.training.objective import UNSCALED, Settings, TrajectoryLoss, scaled_loss
from hybrid_jax.trajectories import Trajectories, check_like, concatenate, features_of, overflows, shares_outside

HELD_OUT = 5  # the last of so many equal parts of the windows is held out for validation
NO_MOTION = "field: its training windows are unknown, so its network may err by 20% of its effect; pass learned_from="
OVERLAP = "windows overlap: left-out blocks share samples with the others, so the expected errors are too small"

_vector_of = jit_with(UNOPTIMISED)(ConstantDisturbance.vector)

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
"""The methods of `adapt` by name."""


@overload
def adapt(
    field: AbstractVectorField,
    windows: Trajectories | list[Trajectories],
    *,
    method: str | Method = "auto",
    validation: Trajectories | None = None,
    learned_from: Trajectories | None = None,
    settings: Settings | None = None,
    level: float = 0.95,
) -> Adaptation: ...
@overload
def adapt(
    field: RecordFit | StateSpaceModel, windows: Sequence[Record], *, level: float = 0.95, dt: float, **of_records: Any
) -> RecordAdaptation: ...
@entry
def adapt(
    field: AbstractVectorField | RecordFit | StateSpaceModel,
    windows: Any,  # as in the two signatures above
    *,
    method: str | Method = "auto",
    validation: Trajectories | None = None,
    learned_from: Trajectories | None = None,
    settings: Settings | None = None,
    level: float = 0.95,
    **of_records: Any,
) -> Adaptation | RecordAdaptation:
    """Adapt a trained field to a few windows of a changed system, or a model with outputs to records.

    Args:
        field: a trained `Hybrid`, or any other field. If only some states are measured: a `RecordFit` or a
            `StateSpaceModel`; this then is `adapt_records`, and the arguments down to `settings` do not apply.
        windows: windows of the changed system, in order of time and without overlap, or its records. You need more
            windows than parameters. If they follow each other, for example in one flight, intervals allow for errors
            that are correlated within a fifth of the windows. NaN in x means "not measured" and counts as no error, as
            do outliers; x0 and u must be finite. You may pass a list with the windows of each flight: `expected` then
            counts flights.
        method: a name in `METHODS`, or a value such as `FineTune(seed=1)`; see `Method` to write your own.
        validation: windows for early stopping and penalties; you should take them from another flight. By default the
            last fifth of `windows` is held out if the method needs validation.
        learned_from: windows that the source was trained on, by default those that `hj.fit` stores in its networks.
            "auto" uses them to estimate the source's own error, and the report warns if `windows` are unlike them. If
            you pass them in the order of time, `expected` has better intervals.
        settings: by default RK4, minibatches of at most 100, and the objective `scaled_loss(field, windows)`, which is
            independent of units; "auto" scales by `learned_from` instead if it is known.
        level: confidence level of the intervals, between 0 and 1.
        of_records: for records: dt and the other arguments of `adapt_records`.

    Raises:
        ValueError: if the method is unknown, windows are malformed, too few or of another system, or the method cannot
            adapt the field.
    """
    checks.not_traced("adapt", field, windows, validation, learned_from)
    if isinstance(field, RecordFit | StateSpaceModel):
        own = {"validation": validation, "learned_from": learned_from, "settings": settings}
        of_windows = [name for name, one in own.items() if one is not None] + ["method"] * (method != "auto")
        if of_windows:
            raise ValueError(f"{of_windows[0]} is for windows with measured states, not for records")
        return adapt_records(field, windows, level=level, **of_records)
    if of_records:
        raise TypeError(f"{min(of_records)} is an argument for records, which need a RecordFit or a StateSpaceModel")
    name, method = _named(method)
    flights = None
    if isinstance(windows, list):
        parts = checks.list_of("windows", windows, Trajectories)
        windows, flights = concatenate(parts), np.repeat(np.arange(len(parts)), [len(each) for each in parts])
    windows = check_windows(field, windows, missing=True)
    learned_from = motion_of(field) if learned_from is None else learned_from
    if learned_from is not None:
        learned_from = check_windows(field, learned_from, "learned_from", missing=True)
        check_like(learned_from, windows, "learned_from", dt=False)
    check_level(level)
    if settings is not None:
        checks.instance("settings", settings, Settings)
    solver = None if settings is None else settings.solver
    for data in (windows,) if validation is None else (windows, validation):
        checked(field, data.x0[0], data.u[0], data.dt, solver)
    exact, size = getattr(method, "has_intervals", False), size_of(field)
    if exact and size > NAMED:
        physics = type(physics_of(field)).__name__
        raise ValueError(f"field: {physics} has {size} unnamed parameters, too many to fit; use method='fine_tune'")
    if (reason := check_savable(field)) is not None:
        checks.warn(reason)
    if overlap(windows):
        checks.warn(OVERLAP)
    keep_programs("adapt", windows.x.shape)
    with solver_errors(solver):
        errors = np.asarray(errors_in(windows, field, compact(solver)))
    not_measured = float(np.isnan(windows.x).mean())
    windows, good, set_aside = without_outliers(windows, errors)
    errors = errors if good.all() else errors[good]
    flights = None if flights is None or len(set(flights[good])) < 2 else flights[good]
    train, held_out = _split(windows, validation, getattr(method, "uses_validation", True))
    if validation is not None:
        held_out = check_windows(field, held_out, "validation", missing=True)
    check_like(held_out, train, "validation")
    settings = Settings() if settings is None else settings
    motion: dict[str, Any] = {"learned_from": learned_from} if getattr(method, "uses_motion", False) else {}
    if settings.objective is UNSCALED:
        settings = replace(settings, objective=scaled_loss(field, motion.get("learned_from") or train))
    if motion and learned_from is None and has_network(field):
        checks.warn(NO_MOTION)
    if motion and len(windows) <= size:
        checks.warn(FEW.format(len(windows), size))
    load_lapack()
    keep_programs("adapt", windows.x.shape)
    diverged = Solution(field, status=Status.DIVERGED) if overflows(windows) or overflows(held_out) else None
    with solver_errors(solver):
        units = {"flights": flights} if motion and flights is not None else {}
        solution = diverged or method.solve(field, train, held_out, settings, **motion, **units)
    if not isinstance(solution, Solution):
        raise ValueError(f"method: {name}.solve must return a Solution, got {type(solution).__name__}")
    adapted = solution.field
    if disturbance_of(field) is None:
        adapted = uncorrected(disturbance.without_zeros(adapted))  # only corrections that were fitted
    status = Status(int(solution.status))
    if status != Status.DIVERGED and isinstance(settings.objective, TrajectoryLoss):
        scale = settings.objective.divisor()
        compare_steps(adapted, windows, solver, scale, named=exact or None)
    space, found = state_space(field, windows.x0.shape[-1]), disturbance_of(adapted)
    choice = {} if solution.choice is None else _chosen(solution.choice, train, space, flights)
    without = None if exact else NOT_LEAST_SQUARES
    without = NOT_FINITE if status == Status.DIVERGED else without
    ranges = [] if learned_from is None else [features_of(w, space) for w in (learned_from, windows)]
    return Adaptation(
        field=adapted,
        method=name,
        disturbance=None if found is None else np.asarray(_vector_of(found, windows.x0.shape[-1])),
        mse_before=_mse(errors, windows),
        mse_after=_mse(errors_in(windows, adapted, compact(settings.solver)), windows),
        windows=len(windows),
        steps=int(solution.steps),
        status=status,
        level=level,
        set_aside=set_aside,
        not_measured=not_measured,
        outside=shares_outside(*ranges) if ranges else {},
        **choice,
        **parameters_of(field, adapted, train, settings, level, without, solution.choice),
    )


def _mse(errors, windows: Trajectories) -> float:
    with np.errstate(over="ignore", invalid="ignore"):
        return float(np.mean(np.sum(np.square(np.where(np.isnan(windows.x), 0, errors)), axis=-1)))


def _chosen(choice: Choice, windows: Trajectories, space: StateSpace, flights) -> dict[str, Any]:
    return {
        "candidates": dict(zip(choice.names, np.asarray(choice.probability).tolist(), strict=True)),
        "chosen": choice.names[int(choice.taken)],
        "physics_only": bool(choice.alone),
        "rejected": tuple(name for name, one in zip(choice.names, np.asarray(choice.rejected), strict=True) if one),
        "expected": choice.expected(windows, space, flights),
        "units": {one.name: one.unit for one in space.quantities},
    }


def _named(method: str | Method) -> tuple[str, Method]:
    if isinstance(method, str):
        if method not in METHODS:
            raise ValueError(f"method must be one of {', '.join(METHODS)}, or a Method, got {method!r}")
        return method, METHODS[method]
    if isinstance(method, type) or not callable(getattr(method, "solve", None)):
        raise ValueError(f"method must be a Method with a function solve, got {checks.short_repr(method)}")
    return type(method).__name__, method


def _split(windows: Trajectories, validation: Trajectories | None, needed: bool) -> tuple[Trajectories, Trajectories]:
    """Split into training and validation windows; both are all windows if no validation is needed."""
    if validation is not None or not needed:
        return windows, windows if validation is None else validation
    if len(windows) < 2:
        raise ValueError("windows must be at least two, to hold one out for validation; else pass validation=")
    last = len(windows) - max(1, len(windows) // HELD_OUT)
    return windows[:last], windows[last:]
