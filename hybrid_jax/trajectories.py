"""Windows of recorded trajectories: an initial state, the next inputs, and the resulting states."""

import math
from collections.abc import Iterable, Mapping
from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hybrid_jax import checks
from hybrid_jax.state_space import StateSpace

SAME = 1e-3  # relative difference of two dt that clocks may cause
RANGE = 0.01, 0.99  # quantiles of the training samples
WARN = 0.1  # share of samples outside this range that is worth a warning

Features = Mapping[str, np.ndarray]


def _plain(dt):
    """Convert a NumPy scalar to a Python number, since Equinox would treat it as an array."""
    return dt.item() if isinstance(dt, np.floating) else dt


class Trajectories(eqx.Module):
    """Windows: n pieces of recordings, each of t equal intervals.

    Attributes:
        x0: the initial state of each window (n, d). You should use SI units, and not scale it.
        u: the input (n, t, m), constant during each interval.
        x: state at the end of each interval (n, t, d): x[:, i] is (i + 1) dt after x0. For `fit`, `adapt` and least
            squares, it should be NaN where nothing was measured.
        dt: length of an interval [s].
    """

    x0: Float[Array | np.ndarray, "*n d"]
    u: Float[Array | np.ndarray, "*n t m"]
    x: Float[Array | np.ndarray, "*n t d"]
    dt: float = eqx.field(static=True, converter=_plain)

    def __len__(self) -> int:
        return self.x0.shape[0]

    @property
    def horizon(self) -> int:
        """The number t of intervals."""
        return self.x.shape[-2]

    def __getitem__(self, index) -> "Trajectories":
        """Return the windows at an index, a slice or an array of indices, which may be traced."""
        # JAX would clamp the index, and a loop over the windows would not end.
        if isinstance(index, int | np.integer) and not -len(self) <= index < len(self):
            raise IndexError(f"index {index} is out of range, as there are {len(self)} windows")
        return jax.tree.map(lambda leaf: leaf[index], self)


def check(trajectories: Trajectories, name: str = "trajectories", missing: bool = False) -> Trajectories:
    """Return the trajectories unchanged; ValueError for wrong shapes or dt or, unless traced, numbers not finite.

    If `missing`, x may contain NaN, but not everywhere.
    """
    if not isinstance(trajectories, Trajectories):
        raise ValueError(f"{name}: must be Trajectories (see `concatenate`), got {type(trajectories).__name__}")
    x0, u, x = trajectories.x0, trajectories.u, trajectories.x
    parts = {"x0": x0, "u": u, "x": x}
    for part, array in parts.items():
        found = getattr(array, "dtype", type(array).__name__)
        if not isinstance(array, checks.Numbers) or found not in (np.float32, np.float64):
            raise ValueError(f"{name}: {part} must be an array of float32 or float64, got {found}")
    if (axes := (x0.ndim, u.ndim, x.ndim)) != (2, 3, 3):
        raise ValueError(f"{name}: x0, u, x must have 2, 3, 3 axes (n, d), (n, t, m), (n, t, d), got {axes}")
    n, d = x0.shape
    if x.shape != (n, u.shape[1], d) or u.shape[0] != n:
        raise ValueError(f"{name}: shapes of x0 {x0.shape}, u {u.shape} and x {x.shape} do not agree")
    if min(n, d, u.shape[1]) == 0:
        raise ValueError(f"{name}: is empty: x0 {x0.shape}, u {u.shape}")
    if isinstance(trajectories.dt, np.ndarray | jax.Array):
        raise ValueError(f"{name}: dt must be a number and not an array, such as float(dt)")
    checks.positive(f"{name}: dt", trajectories.dt, "a positive number of seconds")
    for part, array in parts.items():
        remedy = {"x0": "begin where every state is measured, or see `fit_records`", "x": "leave such windows out"}
        checks.finite(f"{name}: {part}", array, remedy.get(part, ""), missing and part == "x")
    if missing and not checks.is_traced(x) and np.isnan(np.asarray(x)).all():
        raise ValueError(f"{name}: x is NaN everywhere: no state was measured")
    return trajectories


def errors_of(predicted: Float[Array, "*s"], x: Float[Array | np.ndarray, "*s"]) -> Float[Array, "*s"]:
    """Return predicted minus measured states; zero, also in derivatives, where x is NaN because it was not measured."""
    return jnp.where(jnp.isnan(x), 0, predicted - x)


def last_measured(windows: Trajectories) -> Float[np.ndarray, "*n t d"]:
    """Return the states x with each NaN, where nothing was measured, replaced by the last measured value."""
    x = np.asarray(windows.x)
    if not (missing := np.isnan(x)).any():
        return x
    path = np.concatenate([np.asarray(windows.x0)[..., None, :], x], axis=-2)
    places = np.arange(1, path.shape[-2])[:, None]
    last = np.maximum.accumulate(np.where(missing, 0, places), axis=-2)
    return np.take_along_axis(path, last, axis=-2)


def overflows(trajectories: Trajectories) -> bool:
    """Whether squares of the states overflow their type, for example of 1e30 in float32, so that no loss is finite."""
    states = np.asarray(trajectories.x0), np.asarray(trajectories.x)
    most = np.finfo(jax.dtypes.canonicalize_dtype(states[0].dtype)).max / states[0].shape[-1]
    return max(max(part.max(), -part.min()) for part in states) > most**0.5


def check_like(trajectories: Trajectories, windows: Trajectories, name: str, dt: bool = True) -> None:
    """Raise ValueError unless the sizes of state and input, and dt if `dt`, agree with other windows."""
    for part, axis in (("x0", "states"), ("u", "inputs")):
        expected, found = (getattr(each, part).shape[-1] for each in (windows, trajectories))
        if found != expected:
            raise ValueError(f"{name}: {axis} of {expected} numbers expected, as in the other windows, got {found}")
    if dt and not math.isclose(trajectories.dt, windows.dt, rel_tol=SAME):
        raise ValueError(f"{name}: dt must be {windows.dt}, as in the other windows, got {trajectories.dt}")


def split(trajectories: Trajectories, at: int) -> tuple[Trajectories, Trajectories]:
    """Split each window into its first `at` intervals and the rest; ValueError if a part would be empty.

    Args:
        trajectories: windows, or one window without its axis.
        at: number of intervals of the first part.
    """
    checks.count("at", at)
    if not at < trajectories.horizon:
        raise ValueError(f"at must lie between 0 and the horizon {trajectories.horizon}, got {at}")
    x0, u, x, dt = trajectories.x0, trajectories.u, trajectories.x, trajectories.dt
    head = Trajectories(x0, u[..., :at, :], x[..., :at, :], dt)
    return head, Trajectories(x[..., at - 1, :], u[..., at:, :], x[..., at:, :], dt)


def pair_inputs(windows: Trajectories) -> Trajectories:
    """Return windows with the inputs (2m) of each interval and of the next, without each window's last interval.

    Args:
        windows: windows of at least two intervals, whose inputs are samples at the start of each; see
            `dynamics.SampledRotors`. ValueError if they have only one.
    """
    if windows.horizon < 2:
        raise ValueError("windows must have two intervals or more, so that there is a next input, got one")
    x, u = windows.x[..., :-1, :], windows.u
    return replace(windows, u=np.concatenate([u[..., :-1, :], u[..., 1:, :]], axis=-1), x=x)


def windows_of(
    states: Float[np.ndarray, "t+1 d"],
    inputs: Float[np.ndarray, "t m"],
    dt: float,
    *,
    steps: int,
    stride: int | None = None,
) -> Trajectories:
    """Cut one trajectory, states[i] → states[i + 1] under inputs[i], into windows of `steps` intervals.

    Numbers that are not finite are accepted. You should remove windows with gaps afterwards.

    Args:
        states: the state at the start and after each interval (t + 1, d).
        inputs: the input during each interval (t, m).
        dt: length of an interval [s].
        steps: number of intervals in each window.
        stride: number of intervals between the starts of two windows; by default `steps`, so that they do not overlap.

    Raises:
        ValueError: if an array has the wrong shape or type, dt is not positive, or the trajectory is too short.
    """
    arrays = {"states": states, "inputs": inputs}
    states, inputs = (np.asarray(checks.real_array(name, array)) for name, array in arrays.items())
    if states.ndim != 2 or inputs.ndim != 2 or len(states) != len(inputs) + 1:
        raise ValueError(f"states (t + 1, d) and inputs (t, m) expected, got shapes {states.shape} and {inputs.shape}")
    checks.positive("dt", dt, "a positive number of seconds")
    stride = steps if stride is None else stride
    checks.count("steps", steps)
    checks.count("stride", stride)
    if len(inputs) < steps:
        raise ValueError(f"a flight of {len(inputs)} intervals has no window of steps={steps}, stride={stride}")
    starts = np.arange(0, len(inputs) - steps + 1, stride)
    inside = starts[:, None] + np.arange(steps)
    return Trajectories(x0=states[starts], u=inputs[inside], x=states[inside + 1], dt=dt)


def concatenate(windows: Iterable[Trajectories]) -> Trajectories:
    """Join windows in their order; ValueError if there are none, or dt, horizon, or sizes of state or input differ.

    Args:
        windows: parts, which should have the same dt, horizon, and sizes of state and input.
    """
    parts = checks.list_of("windows", windows, Trajectories)
    if len({(part.dt, part.x.shape[1:], part.u.shape[1:]) for part in parts}) != 1:
        sizes = [(part.dt, part.horizon, part.x.shape[-1], part.u.shape[-1]) for part in parts]
        raise ValueError(f"windows must share dt and horizon, and sizes of state and input, got {sizes}")
    return jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)


def features_of(windows: Trajectories, space: StateSpace) -> Features:
    x, u = np.asarray(windows.x), np.asarray(windows.u)
    x, u = (part.reshape(x.shape[0] * x.shape[1], part.shape[-1]) for part in (x, u))
    return space.features(x, u)


def shares_outside(known: Features, asked: Features) -> dict[str, float]:
    """Return the fraction of samples outside the 1 to 99 % range of the known ones, by quantity."""
    ends = {name: np.nanquantile(values, RANGE) for name, values in known.items()}
    return {name: float(np.mean((asked[name] < low) | (asked[name] > high))) for name, (low, high) in ends.items()}
