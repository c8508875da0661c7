"""Attitudes and frames of whole logs, in NumPy's double precision; q = (w, x, y, z), body → world.

World NED (north-east-down) becomes ENU, body FRD (forward-right-down) becomes FLU (forward-left-up).
"""

from dataclasses import dataclass

import numpy as np
import scipy  # not scipy.spatial, which takes a quarter of a second: it is imported where it is first used
from jaxtyping import Float

Vectors = Float[np.ndarray, "n 3"]
Quaternions = Float[np.ndarray, "n 4"]

# Matrices from a frame to the library's: world z up, body forward-left-up.
WORLDS = {"ENU": np.eye(3), "NED": np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]])}
BODIES = {"FLU": np.eye(3), "FRD": np.diag([1.0, -1, -1])}


@dataclass(frozen=True)
class Frames:
    """The frames of the vectors in a log.

    Attributes:
        world: "ENU", which stands for any world with z up, or "NED".
        body: "FLU" or "FRD".
        velocity: where velocities stand, "world" or "body".
    """

    world: str
    body: str
    velocity: str

    def __post_init__(self):
        for name, known in (("world", WORLDS), ("body", BODIES), ("velocity", ("world", "body"))):
            if getattr(self, name) not in tuple(known):
                raise ValueError(f"{name} must be one of {', '.join(known)}, got {getattr(self, name)!r}")


def rotation_of(q: Quaternions) -> "scipy.spatial.transform.Rotation":
    """Convert to SciPy, which puts the scalar last."""
    return scipy.spatial.transform.Rotation.from_quat(np.roll(q, -1, axis=-1))


def quaternion_of(rotation: "scipy.spatial.transform.Rotation") -> Quaternions:
    """(w, x, y, z)."""
    return np.roll(rotation.as_quat(), 1, axis=-1)


def quaternion_from_matrix(matrix: Float[np.ndarray, "n 3 3"]) -> Quaternions:
    """Of rotation matrices body → world."""
    return quaternion_of(scipy.spatial.transform.Rotation.from_matrix(matrix))


def from_euler(angles: Vectors) -> Quaternions:
    """Body → world from (roll, pitch, yaw) [rad], turned about z by yaw, then y by pitch, then x by roll."""
    return quaternion_of(scipy.spatial.transform.Rotation.from_euler("ZYX", angles[:, ::-1]))


def rates_between(t: Float[np.ndarray, " n"], q: Quaternions) -> Float[np.ndarray, "n-1 3"]:
    """Mean body rates [rad/s] that turn each attitude into the next."""
    attitude = rotation_of(q)
    return (attitude[:-1].inv() * attitude[1:]).as_rotvec() / np.diff(t)[:, None]


def interpolate_attitude(t: Float[np.ndarray, " m"], at: Float[np.ndarray, " n"], q: Quaternions) -> Quaternions:
    """Spherical linear interpolation of q, known at times `at`, to times t within them."""
    return quaternion_of(scipy.spatial.transform.Slerp(at, rotation_of(q))(t))


def interpolate(t: Float[np.ndarray, " m"], at: Float[np.ndarray, " n"], values: Float[np.ndarray, "n d"]):
    """Linear interpolation of each column."""
    return np.stack([np.interp(t, at, column) for column in values.T], axis=1)


def mean_of_held(t: Float[np.ndarray, " m"], at: Float[np.ndarray, " n"], values: Float[np.ndarray, "n d"]):
    """Average values, each held from `at` to the next, over each interval of t; the last is held.

    Slow values are returned as they are; of fast ones, none is lost.
    """
    if len(t) == 1:
        return values[np.searchsorted(at, t, side="right") - 1]
    area = np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(values[:-1] * np.diff(at)[:, None], axis=0)])
    end = max(t[-1], at[-1]) + 1.0
    area = np.concatenate([area, area[-1:] + values[-1:] * (end - at[-1])])
    mean = np.diff(interpolate(t, np.append(at, end), area), axis=0) / np.diff(t)[:, None]
    return np.concatenate([mean, values[np.searchsorted(at, t[-1:], side="right") - 1]])
