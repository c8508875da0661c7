"""`adapt`: one call that adapts any field to windows of a changed system, by any method."""

import warnings

import equinox as eqx
import jax
import numpy as np

from hybrid_jax import checks
from hybrid_jax.adaptation.least_squares import check_windows
from hybrid_jax.adaptation.methods import METHODS, Method, Solution, scale_of
from hybrid_jax.adaptation.result import NOT_LEAST_SQUARES, STATUS, UNDETERMINED, Adaptation, Parameter
from hybrid_jax.adaptation.uncertainty import check_level, covariance_of, intervals, named_parameters
from hybrid_jax.dynamics.base import AbstractVectorField, trainable
from hybrid_jax.dynamics.disturbance import disturbance_of, physics_of, without_disturbance
from hybrid_jax.dynamics.rigid_body import AbstractRigidBody, moves_a_rigid_body
from hybrid_jax.integrate import checked
from hybrid_jax.io.models import check_savable
from hybrid_jax.metrics import rollout_mse
from hybrid_jax.training.channels import MULTIROTOR, Channel, ChannelLoss
from hybrid_jax.training.fitting import DIVERGED
from hybrid_jax.training.objective import Settings
from hybrid_jax.trajectories import Trajectories

HELD_OUT = 5  # one in so many windows validates
NAMED = 50  # physics with more parameters is a network, and its weights are not listed
FLOOR = 1e-3  # least scale of a state over its size: one that hardly changes must not outweigh the others

# Of a rigid body's parameters, and of its disturbance; another class may have a class attribute `units` like this.
UNITS = {"Ix": "kg m²", "Iy": "kg m²", "Iz": "kg m²", "k": "N s²", "k_rotors": "N s²", "torque_coefficient": "N m s²"}
UNITS |= {"centre_of_mass": "m", "drag": "N s/m", "cable_pull": "1/m", "aerodynamic_moment": "N s"}
UNITS |= {"rate_damping": "N m s", "velocity_lag": "s"}
UNITS |= {f"disturbance[v{axis}]": "m/s²" for axis in "xyz"} | {f"disturbance[w{axis}]": "rad/s²" for axis in "xyz"}

_mse = eqx.filter_jit(rollout_mse)


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
    settings = Settings(objective=scaled_loss(field, train)) if settings is None else settings
    for part, data in (("windows", windows), ("validation", held_out)):
        check_windows(field, data, part)
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
    adapted, found = solution.field, disturbance_of(solution.field)
    disturbance = None if found is None else np.asarray(found.vector(windows.x0.shape[-1]))
    if disturbance_of(field) is None and not np.any(disturbance):  # the windows need none
        adapted, disturbance = without_disturbance(adapted), None
    finite = int(solution.status) != DIVERGED
    parameters, missing = _parameters(adapted, train, settings, level, exact and finite)
    return Adaptation(
        field=adapted,
        method=name,
        parameters=parameters,
        disturbance=disturbance,
        mse_before=float(_mse(field, windows, solver=settings.solver)),
        mse_after=float(_mse(adapted, windows, solver=settings.solver)),
        windows=len(windows),
        steps=int(solution.steps),
        status=STATUS[int(solution.status)],
        level=level,
        without_intervals=missing,
    )


def scaled_loss(field: AbstractVectorField, windows: Trajectories) -> ChannelLoss:
    """A loss relative to the RMS change over a window of each state, or of each vector in the state of a rigid body."""
    d = windows.x0.shape[-1]
    parts = MULTIROTOR.values() if moves_a_rigid_body(field) else [slice(i, i + 1) for i in range(d)]
    x0, end = np.asarray(windows.x0, float), np.asarray(windows.x[:, -1], float)

    def rms(values: np.ndarray) -> float:
        return float(np.sqrt(np.mean(np.sum(np.square(values), axis=-1))))

    scales = [max(rms(end[:, part] - x0[:, part]), FLOOR * rms(end[:, part])) or 1.0 for part in parts]
    return ChannelLoss(tuple(Channel(part.start, part.stop, s) for part, s in zip(parts, scales, strict=True)))


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
    if validation is not None:
        return windows, validation
    if not needed:
        return windows, windows
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
    units = UNITS if isinstance(own, AbstractRigidBody) else getattr(own, "units", {})
    values = {
        name: Parameter(float(value), unit=units.get(name, units.get(name.split("[")[0])))
        for name, value in named_parameters(field).items()
    }
    if not exact:
        return values, NOT_LEAST_SQUARES
    scale = scale_of(settings.objective, windows.x0.shape[-1])
    covariance = covariance_of(field, windows, solver=settings.solver, scale=scale)
    if not np.isfinite(covariance).all():
        return values, UNDETERMINED
    found = intervals(field, covariance, level)
    return {name: Parameter(*map(float, found[name]), unit=one.unit) for name, one in values.items()}, None
