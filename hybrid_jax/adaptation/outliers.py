"""Find windows with outliers, such as bursts of bad samples, before a model is adapted to them."""

import numpy as np
from jaxtyping import Bool, Float

from hybrid_jax.trajectories import Trajectories

ORDER = 3  # of the differences, which are small for a smooth model error
FAR = 8.0  # robust standard deviations, which none of a million normal errors reaches
DEVIATION = 1.4826  # the standard deviation of normal errors over their median size
ROUGH = 0.3  # of the window's largest error: an error with smaller differences is smooth


def outliers(errors: Float[np.ndarray, "n t d"], windows: Trajectories) -> Bool[np.ndarray, " n"]:
    """Return which windows contain an outlier, which may be the initial state; errors are measured minus predicted.

    At an outlier, differences of successive errors are much larger than usual (Hampel 1974), nearly as large as the
    errors, and larger than the same differences of the predicted states, so that no motion explains them.
    """
    if len(errors) < 1 or errors.shape[1] < ORDER:
        return np.zeros(len(errors), bool)
    with np.errstate(invalid="ignore", over="ignore"):
        size = np.nan_to_num(np.abs(errors)).max(axis=1)
        start = np.asarray(windows.x0)[:, None]
        predicted = np.concatenate([start, np.asarray(windows.x) - errors], axis=1)
        motion = np.nan_to_num(np.abs(np.diff(predicted, ORDER, axis=1))).max(axis=1)
        rough = np.abs(np.diff(np.pad(errors, ((0, 0), (1, 0), (0, 0))), ORDER, axis=1))
        rounding = np.finfo(errors.dtype).eps * np.abs(np.nan_to_num(windows.x)).max((0, 1))
        known = (each[~np.isnan(each)] for each in rough.T)
        usual = DEVIATION * np.array([np.median(each) if each.size else np.inf for each in known]) + rounding
        rough = np.nan_to_num(rough).max(axis=1)
        return ((rough > FAR * usual) & (rough > ROUGH * size) & (rough > motion)).any(axis=1)
