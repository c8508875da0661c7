"""Check windows against the field that predicts them."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from hybrid_jax import checks
from hybrid_jax.dynamics.base import AbstractVectorField, as_field, ravel_learned, state_space
from hybrid_jax.dynamics.disturbance import physics_of
from hybrid_jax.runtime import UNOPTIMISED, jit_by_size
from hybrid_jax.state_space import Attitude, Quantity, StateSpace
from hybrid_jax.trajectories import Trajectories, check, last_measured

ALIKE, FAR = 0.9, 3.0  # correlation of changes and integrated rates; factor beyond which their units differ
TINY = 1e-12  # added to the size of a change
SOME, FASTEST = 200, 8  # windows, and samples of them, whose rates are compared
MANY = 100  # states: more are those of a grid, where thousands of pairs are alike and all have one unit


def check_windows(
    field: AbstractVectorField, windows: Trajectories, name: str = "windows", missing: bool = False
) -> Trajectories:
    """Return checked windows without jumps between representations of a state, in double precision if the field is.

    If `missing`, x may contain NaN where a state was not measured.
    """
    check(windows, name, missing)
    space = state_space(field, windows.x0.shape[-1])
    known = windows.x if checks.is_traced(windows.x) else last_measured(windows)
    for part, states in (("x0", windows.x0), ("x", known)):
        space.check(f"{name}: {part}", states)
    _warn_of_turns(space, windows.x0, known, name)
    windows = continuous(field, windows)
    _warn_of_units(field, space, windows, name)
    return windows


def _warn_of_turns(space: StateSpace, x0, x, name: str) -> None:
    """Warn about numbers that jump by 2π, like a wrapped angle, and otherwise change little."""
    if checks.is_traced(x0) or checks.is_traced(x):
        return
    path = np.concatenate([np.asarray(x0)[:, None], x], axis=1)
    for part, one in space.parts:
        for i in np.flatnonzero(jumps := turns(path[..., part])) if one.is_vector else ():
            where = f"{name}: x[{part.start + i}] jumps by about 2π in {jumps[i]} of {len(path)} windows"
            remedy = "if it is an angle, unwrap it, or give the field a `state_space` with an `Angle`"
            checks.warn(f"{where}; {remedy}")


def turns(path: Float[np.ndarray, "n t k"], turn: float = 2 * np.pi) -> Int[np.ndarray, " k"]:
    """Count the windows in which each number changes at once by about a turn; zero if it has other large changes."""
    moved = np.abs(np.diff(path, axis=1)).max(axis=1, initial=0.0)
    large = moved > turn / 4
    return np.where((~large | (np.abs(moved - turn) < turn / 6)).all(axis=0), large.sum(axis=0), 0)


def _warn_of_units(field: AbstractVectorField, space: StateSpace, windows: Trajectories, name: str) -> None:
    """Warn about a state that is the rate of another one in the physics, but has another unit in the windows."""
    if windows.x.shape[-1] > MANY or any(map(checks.is_traced, jax.tree.leaves((field, windows)))):
        return
    windows = jax.tree.map(np.asarray, windows[:: -(-len(windows) // SOME)])
    path = np.concatenate([windows.x0[:, None], windows.x], axis=1).astype(float)
    whole = ~np.isnan(path).any(axis=(1, 2))
    path, x, u = path[whole], windows.x0[whole], windows.u[whole, 0]
    moved = np.cumsum(_steps(space, path), axis=1)
    integrated = np.cumsum((path[:, 1:] + path[:, :-1]) * (windows.dt / 2), axis=1)
    gains = foreign_units(*(each.reshape(-1, each.shape[-1]) for each in (moved, integrated)))
    gains[:, [i for part, one in space.parts if not one.is_vector for i in range(part.start, part.stop)]] = 0
    for i, j in np.argwhere(gains > 0):
        fast = np.argsort(-np.abs(x[:, j]))[:FASTEST]
        try:
            slopes = np.asarray(_slopes(physics_of(as_field(field)), jnp.asarray(x[fast]), jnp.asarray(u[fast])))
        except Exception:  # a field that does not accept these windows raises an error when it is first integrated
            return
        rates = _steps(space, np.stack([x[fast] + 0 * slopes, x[fast] + slopes], axis=-2).astype(float))[..., 0, i]
        if np.abs(rates - x[fast, j]).max() < 0.05 * np.abs(x[fast, j]).max():
            rate = f"{name}: x[{j}] is {gains[i, j]:.3g} times the rate of {space.tangent_names[i]}"
            checks.warn(f"{rate}: check their units, and dt")


@jit_by_size(UNOPTIMISED)
def _slopes(field: AbstractVectorField, x: Float[Array, "n d"], u: Float[Array, "n m"]):
    """Return ẋ with these and with other parameters; a state that is a rate for both is one by definition."""
    theta, at = ravel_learned(field)
    return jax.lax.map(lambda theta: jax.vmap(at(theta))(x, u), jnp.stack([theta, 1.3 * theta + 0.1]))


def _steps(space: StateSpace, path: Float[np.ndarray, "*n t d"]) -> Float[np.ndarray, "*n t-1 e"]:
    """Return the small changes from each state to the next, in the tangent space."""

    def of(one: Quantity, values):
        if not isinstance(one, Attitude):
            return np.diff(values, axis=-2)[..., : one.tangent_size]
        (w, v), (next_w, next_v) = ((q[..., :1], q[..., 1:]) for q in (values[..., :-1, :], values[..., 1:, :]))
        return 2 * (w * next_v - next_w * v - np.cross(v, next_v))

    return np.concatenate([of(one, path[..., part]) for part, one in space.parts], axis=-1)


def foreign_units(moved: Float[np.ndarray, "s e"], integrated: Float[np.ndarray, "s d"]) -> Float[np.ndarray, "e d"]:
    """Return the ratio of integrals to changes where they are proportional and the ratio is another unit; else 0."""
    sizes = np.linalg.norm(moved, axis=0)[:, None] + TINY, np.linalg.norm(integrated, axis=0)
    alike, gains = moved.T @ integrated > ALIKE * sizes[0] * sizes[1], sizes[1] / sizes[0]
    return np.where(alike & ~((gains > 1 / FAR) & (gains < FAR)), gains, 0.0)


def continuous(field: AbstractVectorField, windows: Trajectories) -> Trajectories:
    """Convert windows as `check_windows` does, without checking the states."""
    double = any(eqx.is_inexact_array(leaf) and leaf.dtype == jnp.float64 for leaf in jax.tree.leaves(field))
    if double and windows.x0.dtype != jnp.float64:  # a step of the solver keeps a type
        windows = replace(windows, **{part: getattr(windows, part).astype(jnp.float64) for part in ("x0", "u", "x")})
    if checks.is_traced(windows.x0) or checks.is_traced(windows.x):
        return windows
    path = np.concatenate([np.asarray(windows.x0)[:, None], last_measured(windows)], axis=1)
    found = [one.continuous(path[..., part]) for part, one in state_space(field, path.shape[-1]).parts]
    if np.array_equal(joined := np.concatenate(found, axis=-1), path):
        return windows
    return replace(windows, x=np.where(np.isnan(windows.x), np.nan, joined[:, 1:]))
