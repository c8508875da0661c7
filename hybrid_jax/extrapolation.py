"""How far a flight lies outside of the flight that a model was trained on."""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float

from hybrid_jax.rotation import tilt
from hybrid_jax.state import BODY_RATES, QUATERNION, VELOCITY
from hybrid_jax.trajectories import Trajectories

RANGE = 0.01, 0.99  # quantiles of the training samples
WARN = 0.1  # share of samples outside of it that is worth a warning

Motion = Mapping[str, np.ndarray]


def motion(x: Float[np.ndarray, "n d"], u: Float[np.ndarray, "n m"], rigid: bool) -> Motion:
    """What decides whether a model has seen the like of a sample: of a rigid body speed, body rates, rotor speeds and
    tilt; of another system each state and input."""
    if not rigid:
        return {f"{name}[{i}]": column for name, part in (("x", x), ("u", u)) for i, column in enumerate(part.T)}
    lengths = {"speed [m/s]": x[:, VELOCITY], "body rates [rad/s]": x[:, BODY_RATES]}
    norms = {name: np.linalg.norm(each, axis=1) for name, each in lengths.items()}
    return norms | {"rotor speed [rad/s]": u.ravel(), "tilt [rad]": tilt(x[:, QUATERNION])}


def motion_of(windows: Trajectories, rigid: bool) -> Motion:
    """`motion` of every sample of some windows."""
    x, u = np.asarray(windows.x), np.asarray(windows.u)
    x, u = (part.reshape(x.shape[0] * x.shape[1], part.shape[-1]) for part in (x, u))
    return motion(x, u, rigid)


def shares_outside(known: Motion, asked: Motion) -> dict[str, float]:
    """By quantity the share of samples outside the 1 to 99 % range of the known ones."""
    ends = {name: np.quantile(values, RANGE) for name, values in known.items()}
    return {name: float(np.mean((asked[name] < low) | (asked[name] > high))) for name, (low, high) in ends.items()}
