"""Attitudes q = (w, x, y, z), body → world, and frames of whole logs, in NumPy's double precision."""

from dataclasses import dataclass

import numpy as np
import scipy  # not scipy.spatial, which takes a quarter of a second: it is imported where it is first used
from jaxtyping import Float

from hybrid_jax.records import Signal, integral

Vectors = Float[np.ndarray, "n 3"]
Quaternions = Float[np.ndarray, "n 4"]

# Matrices from a frame to the library's: world z up, body forward-left-up.
WORLDS = {"ENU": np.eye(3), "NED": np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]])}
BODIES = {"FLU": np.eye(3), "FRD": np.diag([1.0, -1, -1])}


@dataclass(frozen=True)
class Frames:
    """The frames of a log: a world of `WORLDS`, a body of `BODIES`, and the frame of velocities, "world" or "body"."""

    world: str
    body: str
    velocity: str

    def __post_init__(self):
        for name, known in (("world", WORLDS), ("body", BODIES), ("velocity", ("world", "body"))):
            if getattr(self, name) not in tuple(known):
                raise ValueError(f"{name} must be one of {', '.join(known)}, got {getattr(self, name)!r}")


def rotation_of(q: Quaternions) -> "scipy.spatial.transform.Rotation":
    return scipy.spatial.transform.Rotation.from_quat(np.roll(q, -1, axis=-1))


def quaternion_of(rotation: "scipy.spatial.transform.Rotation") -> Quaternions:
    return np.roll(rotation.as_quat(), 1, axis=-1)


def quaternion_from_matrix(matrix: Float[np.ndarray, "n 3 3"]) -> Quaternions:
    """Convert rotation matrices body → world."""
    return quaternion_of(scipy.spatial.transform.Rotation.from_matrix(matrix))


def from_euler(angles: Vectors) -> Quaternions:
    """Convert (roll, pitch, yaw) [rad], rotated in the order yaw, pitch, roll, to quaternions body → world."""
    return quaternion_of(scipy.spatial.transform.Rotation.from_euler("ZYX", angles[:, ::-1]))


def rates_between(t: Float[np.ndarray, " n"], q: Quaternions) -> Float[np.ndarray, "n-1 3"]:
    """Compute the mean body rates [rad/s] between consecutive attitudes."""
    attitude = rotation_of(q)
    return (attitude[:-1].inv() * attitude[1:]).as_rotvec() / np.diff(t)[:, None]


def interpolate_attitude(t: Float[np.ndarray, " m"], at: Float[np.ndarray, " n"], q: Quaternions) -> Quaternions:
    """Interpolate attitudes q, sampled at times `at`, spherically to times t within them."""
    return quaternion_of(scipy.spatial.transform.Slerp(at, rotation_of(q))(t))


def interpolate(t: Float[np.ndarray, "*m"], at: Float[np.ndarray, " n"], values: Float[np.ndarray, "n d"]):
    """Interpolate each column linearly."""
    return np.stack([np.interp(t, at, column) for column in values.T], axis=-1)


def mean_of_held(t: Float[np.ndarray, " m"], at: Float[np.ndarray, " n"], values: Float[np.ndarray, "n d"]):
    """Average zero-order-held values over each interval of t, and append the last value; slow signals do not change."""
    area = integral(Signal(at, values), t, "held")
    held = values[np.searchsorted(at, t[-1:], side="right") - 1]
    return np.concatenate([np.diff(area, axis=0) / np.diff(t)[:, None], held])
