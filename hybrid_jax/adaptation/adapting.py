"""`adapt`: one call that adapts any field to windows of a changed system, by any method; one result for all methods."""

import warnings
from dataclasses import asdict, dataclass
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float

from hybrid_jax import checks
from hybrid_jax.adaptation.least_squares import check_windows
from hybrid_jax.adaptation.methods import METHODS, Method, Solution, scale_of
from hybrid_jax.adaptation.uncertainty import check_level, covariance_of, intervals, named_parameters
from hybrid_jax.dynamics.base import AbstractVectorField, trainable
from hybrid_jax.dynamics.disturbance import disturbance_of, physics_of, without_disturbance
from hybrid_jax.dynamics.rigid_body import AbstractRigidBody
from hybrid_jax.integrate import checked
from hybrid_jax.io.models import check_savable
from hybrid_jax.metrics import rollout_mse
from hybrid_jax.training.channels import scaled_loss
from hybrid_jax.training.fitting import CAPPED, DIVERGED, STOPPED
from hybrid_jax.training.objective import Settings
from hybrid_jax.trajectories import Trajectories

HELD_OUT = 5  # one in so many windows validates
NAMED = 50  # physics with more parameters is a network, and its weights are not listed
STATUS = {STOPPED: "converged", CAPPED: "stopped at the limit of steps", DIVERGED: "diverged"}
NOT_LEAST_SQUARES = "they are valid for least squares only, where no network is trained on the same windows"
UNDETERMINED = "the windows do not determine the parameters"

# Of a rigid body's parameters, and of its disturbance; another class may have a class attribute `units` like this.
UNITS = {"Ix": "kg m²", "Iy": "kg m²", "Iz": "kg m²", "k": "N s²", "k_rotors": "N s²", "torque_coefficient": "N m s²"}
UNITS |= {"centre_of_mass": "m", "drag": "N s/m", "cable_pull": "1/m", "aerodynamic_moment": "N s"}
UNITS |= {"rate_damping": "N m s", "velocity_lag": "s"}
UNITS |= {f"disturbance[v{axis}]": "m/s²" for axis in "xyz"} | {f"disturbance[w{axis}]": "rad/s²" for axis in "xyz"}


@dataclass(frozen=True)
class Parameter:
    """A physical parameter and its confidence interval; low and high are None where there is no valid one."""

    value: float
    low: float | None = None
    high: float | None = None
    unit: str | None = None

    def __str__(self) -> str:
        around = "" if self.low is None or self.high is None else f"  ({self.low:.4g} to {self.high:.4g})"
        return f"{self.value:.4g}{f' {self.unit}' if self.unit else ''}{around}"


@dataclass(frozen=True, eq=False)
class Adaptation:
    """An adapted field and what is known about it."""

    field: AbstractVectorField
    method: str  # its name, or its class if it was passed as a value
    parameters: dict[str, Parameter]  # of physics and disturbance; see `uncertainty.named_parameters`
    disturbance: Float[np.ndarray, " d"] | None  # the constant part of ẋ, if there is one
    mse_before: float  # L_MSE of the source field on all windows
    mse_after: float  # and of the adapted one
    windows: int  # their number
    steps: int  # epochs, or evaluations of the Jacobian; 0 for a closed form
    status: str  # one of `STATUS`
    level: float  # confidence level of the intervals
    without_intervals: str | None  # why there are none, if so

    @property
    def converged(self) -> bool:
        """Whether the method stopped by itself, at a finite error."""
        return self.status == STATUS[STOPPED]

    def report(self) -> str:
        """A summary in plain text, a few lines."""
        after = f" after {self.steps} steps" if self.steps else ""
        lines = [
            f"Adapted to {self.windows} windows by {self.method}: {self.status}{after}.",
            f"Mean squared prediction error: {self.mse_before:.3g} before, {self.mse_after:.3g} after.",
        ]
        if self.parameters:
            note = f"{self.level:.0%} confidence intervals" if self.without_intervals is None else "no intervals"
            width = max(map(len, self.parameters))
            lines.append(f"Parameters ({note}):")
            lines += [f"  {name:<{width}}  {parameter}" for name, parameter in self.parameters.items()]
        lines.append(f"Constant disturbance: {'none' if self.disturbance is None else 'see parameters'}.")
        if self.parameters and self.without_intervals is not None:
            lines.append(f"No intervals: {self.without_intervals}.")
        return "\n".join(lines)

    def to_dict(self) -> dict[str, Any]:
        """Everything but the field, as JSON values."""
        parameters = {name: asdict(parameter) for name, parameter in self.parameters.items()}
        disturbance = None if self.disturbance is None else self.disturbance.tolist()
        found = vars(self) | {"converged": self.converged, "disturbance": disturbance, "parameters": parameters}
        return {name: value for name, value in found.items() if name != "field"}


def adapt(
    field: AbstractVectorField,
    windows: Trajectories,
    *,
    method: str | Method = "least_squares",
    validation: Trajectories | None = None,
    settings: Settings | None = None,
    level: float = 0.95,
) -> Adaptation:
    """Adapt a source field to windows of a changed system.

    Args:
        field: a trained `Hybrid`, or any other field.
        windows: independent ones. For least squares more than there are parameters.
        method: a name in `METHODS`, or a value such as `FineTune(seed=1)`; see `Method` for one of your own.
        validation: windows for early stopping and penalties. By default the last fifth of `windows` is held out where
            the method needs some.
        settings: by default RK4, minibatches of at most 100, and `scaled_loss`, so that units do not matter.
        level: confidence level of the intervals.

    Raises:
        ValueError: an unknown method, malformed, too few or other windows, or a field that the method cannot adapt.
    """
    name, method = _named(method)
    check_windows(field, windows)
    check_level(level)
    train, held_out = _split(windows, validation, getattr(method, "uses_validation", True))
    check_windows(field, held_out, "validation")
    settings = Settings(objective=scaled_loss(field, train)) if settings is None else settings
    for data in (windows, held_out):
        checked(field, data.x0, data.u, data.dt, settings.solver, windows=True)
    exact, size = getattr(method, "has_intervals", False), _size(field)
    if exact and size > NAMED:
        physics = type(physics_of(field)).__name__
        raise ValueError(f"field: {physics} has {size} parameters, no named physics to fit; use method='fine_tune'")
    if (reason := check_savable(field)) is not None:
        warnings.warn(reason, stacklevel=2)
    solution = method.solve(field, train, held_out, settings)
    if not isinstance(solution, Solution):
        raise ValueError(f"method: {name}.solve must return a Solution, got {type(solution).__name__}")
    adapted, found, status = solution.field, disturbance_of(solution.field), int(solution.status)
    disturbance = None if found is None else np.asarray(found.vector(windows.x0.shape[-1]))
    if disturbance_of(field) is None and not np.any(disturbance):  # the windows need none
        adapted, disturbance = without_disturbance(adapted), None
    parameters, missing = _parameters(adapted, train, settings, level, exact and status != DIVERGED)
    mse = eqx.filter_jit(rollout_mse)
    return Adaptation(
        field=adapted,
        method=name,
        parameters=parameters,
        disturbance=disturbance,
        mse_before=float(mse(field, windows, solver=settings.solver)),
        mse_after=float(mse(adapted, windows, solver=settings.solver)),
        windows=len(windows),
        steps=int(solution.steps),
        status=STATUS[status],
        level=level,
        without_intervals=missing,
    )


def _named(method: str | Method) -> tuple[str, Method]:
    if isinstance(method, str):
        if method not in METHODS:
            raise ValueError(f"method must be one of {', '.join(METHODS)}, or a value, got {method!r}")
        return method, METHODS[method]
    if isinstance(method, type) or not callable(getattr(method, "solve", None)):
        raise ValueError(f"method must have a method solve, see Method, got {checks.short_repr(method)}")
    return type(method).__name__, method


def _split(windows: Trajectories, validation: Trajectories | None, needed: bool) -> tuple[Trajectories, Trajectories]:
    """The windows to train on and those to validate with; the same where none are needed."""
    if validation is not None or not needed:
        return windows, windows if validation is None else validation
    if len(windows) < 2:
        raise ValueError("windows: one is too few to hold some out; pass validation=")
    last = len(windows) - max(1, len(windows) // HELD_OUT)
    return windows[:last], windows[last:]


def _size(field: AbstractVectorField) -> int:
    """The number of parameters of the physics, without a disturbance."""
    physics = physics_of(without_disturbance(field))
    return sum(leaf.size for leaf in jax.tree.leaves(eqx.filter(physics, trainable(physics))))


def _parameters(
    field: AbstractVectorField, windows: Trajectories, settings: Settings, level: float, exact: bool
) -> tuple[dict[str, Parameter], str | None]:
    """The parameters by name, and why they have no intervals, if they have none."""
    if not 0 < _size(field) <= NAMED:
        return {}, NOT_LEAST_SQUARES
    own = physics_of(without_disturbance(field))
    known = UNITS if isinstance(own, AbstractRigidBody) else getattr(own, "units", {})
    values = named_parameters(field)
    units = {name: known.get(name, known.get(name.split("[")[0])) for name in values}
    alone = {name: Parameter(float(value), unit=units[name]) for name, value in values.items()}
    if not exact:
        return alone, NOT_LEAST_SQUARES
    scale = scale_of(settings.objective, windows.x0.shape[-1])
    covariance = covariance_of(field, windows, solver=settings.solver, scale=scale)
    if not np.isfinite(covariance).all():
        return alone, UNDETERMINED
    found = intervals(field, covariance, level)
    return {name: Parameter(*map(float, found[name]), unit=units[name]) for name in values}, None
