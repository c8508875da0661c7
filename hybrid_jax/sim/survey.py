"""Statistics of recorded windows: speeds, tilts, altitudes and the share in ground effect."""

import numpy as np

from hybrid_jax.state import BODY_RATES, POSITION, QUATERNION, VELOCITY
from hybrid_jax.trajectories import Trajectories

# Mean altitude of the centre over a window [m]. Below, ground effect adds at least 0.4 % and 2.6 % of thrust.
GROUND_EFFECT_BELOW = 0.5
STRONG_GROUND_EFFECT_BELOW = 0.2
PERCENTILES = (1, 50, 99)


def survey(windows: Trajectories) -> dict[str, float]:
    """Shares in [0, 1] and percentiles over all states, by name and unit."""
    x = np.asarray(windows.x)
    altitude = x[..., POSITION][..., 2]
    height = altitude.mean(axis=1)
    rates = np.abs(x[..., BODY_RATES])
    channels = {
        "speed [m/s]": np.linalg.norm(x[..., VELOCITY], axis=-1),
        "tilt [deg]": tilt(x[..., QUATERNION]),
        "altitude [m]": altitude,
        "distance from home [m]": np.linalg.norm(x[..., POSITION][..., :2], axis=-1),
        "|roll rate| [rad/s]": rates[..., 0],
        "|pitch rate| [rad/s]": rates[..., 1],
        "|yaw rate| [rad/s]": rates[..., 2],
        "rotor speed [rad/s]": np.asarray(windows.u),
    }
    shares = {
        f"windows below {GROUND_EFFECT_BELOW} m": float((height < GROUND_EFFECT_BELOW).mean()),
        f"windows below {STRONG_GROUND_EFFECT_BELOW} m": float((height < STRONG_GROUND_EFFECT_BELOW).mean()),
    }
    return shares | {
        f"{name} p{percentile}": float(np.percentile(values, percentile))
        for name, values in channels.items()
        for percentile in PERCENTILES
    }


def tilt(q: np.ndarray) -> np.ndarray:
    """The angle [deg] between body z and world z of quaternions (..., 4)."""
    return np.degrees(np.arccos(np.clip(1 - 2 * (q[..., 1] ** 2 + q[..., 2] ** 2), -1, 1)))
