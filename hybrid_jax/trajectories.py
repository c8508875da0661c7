"""Windows of flight: a start, the inputs held over each interval, and the states that followed."""

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float


class Trajectories(eqx.Module):
    """n windows of t equal intervals.

    Attributes:
        x0: state at the start of each window.
        u: input held over each interval.
        x: state at the end of each interval; x[:, i] is reached from x0 after (i + 1) dt.
        dt: length of an interval [s].
    """

    x0: Float[Array | np.ndarray, "*n d"]
    u: Float[Array | np.ndarray, "*n t m"]
    x: Float[Array | np.ndarray, "*n t d"]
    dt: float = eqx.field(static=True)

    def __len__(self) -> int:
        return self.x0.shape[0]

    @property
    def horizon(self) -> int:
        """The number of intervals t."""
        return self.x.shape[-2]

    def __getitem__(self, index) -> "Trajectories":
        """The windows that index picks: a slice or an array of indices, traced ones included."""
        return jax.tree.map(lambda leaf: leaf[index], self)


def check(trajectories: Trajectories, name: str = "trajectories") -> Trajectories:
    """Return trajectories unchanged after checking shapes, dt and that every number is finite.

    Raises:
        ValueError: which array of `name` is wrong, where, and what was expected.
    """
    x0, u, x = trajectories.x0, trajectories.u, trajectories.x
    if x0.ndim != 2 or u.ndim != 3 or x.ndim != 3:
        raise ValueError(
            f"{name}: x0, u, x must have 2, 3, 3 axes (n, d), (n, t, m), (n, t, d), got {x0.ndim}, {u.ndim}, {x.ndim}"
        )
    n, d = x0.shape
    if x.shape != (n, u.shape[1], d) or u.shape[0] != n:
        raise ValueError(f"{name}: shapes of x0 {x0.shape}, u {u.shape} and x {x.shape} do not agree")
    if min(n, d, u.shape[1]) == 0:
        raise ValueError(f"{name}: is empty: x0 {x0.shape}, u {u.shape}")
    if not (np.isfinite(trajectories.dt) and trajectories.dt > 0):
        raise ValueError(f"{name}: dt must be a positive number of seconds, got {trajectories.dt!r}")
    for field, array in (("x0", x0), ("u", u), ("x", x)):
        bad = ~np.isfinite(np.asarray(array))
        if bad.any():
            raise ValueError(f"{name}: {field}{np.argwhere(bad)[0].tolist()} is not finite")
    return trajectories


def split(trajectories: Trajectories, at: int) -> tuple[Trajectories, Trajectories]:
    """The first `at` intervals of each window, and the rest of it, which starts where they end.

    Raises:
        ValueError: a part would be empty.
    """
    if not 0 < at < trajectories.horizon:
        raise ValueError(f"at must lie between 0 and the horizon {trajectories.horizon}, got {at}")
    x0, u, x, dt = trajectories.x0, trajectories.u, trajectories.x, trajectories.dt
    head = Trajectories(x0, u[..., :at, :], x[..., :at, :], dt)
    return head, Trajectories(x[..., at - 1, :], u[..., at:, :], x[..., at:, :], dt)


def windows_of(
    states: Float[np.ndarray, "t+1 d"],
    inputs: Float[np.ndarray, "t m"],
    dt: float,
    *,
    steps: int,
    stride: int | None = None,
) -> Trajectories:
    """Cut one flight, states[i] → states[i + 1] under inputs[i], into windows of `steps` intervals.

    Args:
        stride: intervals between the starts of two windows; by default `steps`: windows touch but do not overlap.

    Raises:
        ValueError: the flight is shorter than one window.
    """
    stride = steps if stride is None else stride
    if steps < 1 or stride < 1 or len(inputs) < steps:
        raise ValueError(f"a flight of {len(inputs)} intervals has no window of steps={steps}, stride={stride}")
    starts = np.arange(0, len(inputs) - steps + 1, stride)
    inside = starts[:, None] + np.arange(steps)
    return Trajectories(x0=states[starts], u=inputs[inside], x=states[inside + 1], dt=dt)


def concatenate(parts: list[Trajectories]) -> Trajectories:
    """All windows of the parts, in order.

    Raises:
        ValueError: no parts, or parts of different dt or horizon.
    """
    if not parts or len({(part.dt, part.horizon) for part in parts}) != 1:
        raise ValueError(f"parts must share dt and horizon, got {[(part.dt, part.horizon) for part in parts]}")
    return jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)
