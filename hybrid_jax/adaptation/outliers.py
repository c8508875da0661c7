"""Set outliers aside, such as bad samples and bursts of them, before a model is adapted to windows."""

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float

from hybrid_jax import checks
from hybrid_jax.trajectories import Trajectories

ORDER = 3  # of the differences, which are small for a smooth model error
FAR = 8.0  # robust standard deviations, which none of a million normal errors reaches
DEVIATION = 1.4826  # the standard deviation of normal errors over their median size
ROUGH = 0.3  # of the largest error: an error with smaller differences is smooth
PIECE = 32  # samples in which outliers are searched together
FEW = 6  # differences for each outlier of a piece; with fewer, a few outliers could explain a piece that is all wrong
FEWEST = 10  # windows that are enough; if fewer are left, all are used
MANY = "windows: {} of {} begin with an outlier, or have many; that is too many to leave out, so all samples are used"


def without_outliers(
    windows: Trajectories, errors: Float[np.ndarray, "n t d"]
) -> tuple[Trajectories, Bool[np.ndarray, " n"], int]:
    """Return windows in which outliers are NaN, which of `windows` they are, and the number of samples set aside.

    A window that begins with an outlier is left out.
    """
    found = outliers(errors, windows)
    good = ~np.any(found[:, 0], axis=-1)
    if good.sum() < max(FEWEST, len(windows) / 2):
        if not good.all():
            checks.warn(MANY.format((~good).sum(), len(windows)))
        return windows, np.ones(len(windows), bool), 0
    wrong = np.any(found[:, 1:], axis=-1) | ~good[:, None]
    if not wrong.any():
        return windows, good, 0
    return replace(windows, x=np.where(found[:, 1:], np.nan, windows.x))[good], good, int(wrong.sum())


def outliers(errors: Float[np.ndarray, "n t d"], windows: Trajectories) -> Bool[np.ndarray, "n t+1 d"]:
    """Return which numbers in x0 and x are outliers; errors are measured minus predicted.

    Successive errors are smooth but for noise. An outlier makes their differences much larger than usual (Hampel 1974),
    nearly as large as the errors, and larger than those of the predicted states, so that no motion explains them. There
    numbers are taken out one by one, each time the one that explains most, until the other differences are usual. If
    too many would have to go, all numbers of the piece are outliers.
    """
    path = np.pad(np.asarray(errors, float), ((0, 0), (1, 0), (0, 0)))
    found = np.zeros(path.shape, bool)
    if not len(path) or path.shape[1] <= ORDER:
        return found
    with np.errstate(invalid="ignore", over="ignore"):
        start = np.asarray(windows.x0)[:, None]
        predicted = np.concatenate([start, np.asarray(windows.x) - errors], axis=1)
        motion = np.nan_to_num(np.abs(np.diff(predicted, ORDER, axis=1))).max(axis=1)
        rounding = np.finfo(errors.dtype).eps * np.abs(np.nan_to_num(windows.x)).max((0, 1))
        rough = np.abs(np.diff(path, ORDER, axis=1))
        known = (each[~np.isnan(each)] for each in rough.T)
        usual = DEVIATION * np.array([np.median(each) if each.size else np.inf for each in known]) + rounding
        limit = np.maximum(FAR * usual, motion)
        for piece in np.array_split(np.arange(path.shape[1]), -(-path.shape[1] // PIECE)):
            far = np.nan_to_num(rough[:, piece[:-ORDER]]).max(axis=1) > limit
            for i in np.flatnonzero(far.any(axis=-1)):
                at = piece[:, None], np.flatnonzero(far[i])
                found[i][at] = _searched(path[i][at], limit[i, far[i]])
    return found


def _searched(path: Float[np.ndarray, "t d"], limit: Float[np.ndarray, " d"]) -> Bool[np.ndarray, "t d"]:
    """Search each quantity by orthogonal least squares (Chen, Billings, Luo 1989), with a column for each sample."""
    t, d = path.shape
    found, each = np.zeros((d, t), bool), np.arange(d)
    rest = np.diff(path, ORDER, axis=0).T
    columns = np.where(np.isfinite(rest)[..., None], np.diff(np.eye(t), ORDER, axis=0), 0)
    rest = np.where(np.isfinite(rest), rest, 0)
    wild = np.abs(rest).max(axis=-1) > np.maximum(limit, ROUGH * np.abs(np.nan_to_num(path)).max(axis=0))
    if not wild.any():
        return found.T
    for _ in range(len(rest.T) // FEW):
        length = np.sqrt(np.sum(columns**2, axis=1))
        unit = np.where(length[:, None] > 1e-6, columns / length[:, None], 0)
        most = np.argmax(np.abs(np.einsum("dkt,dk->dt", unit, rest)), axis=-1)
        found[each, most] |= wild
        direction = unit[each, :, most]
        rest = rest - np.einsum("dk,dk,dl->dl", direction, rest, direction)
        columns = columns - np.einsum("dk,dkt,dl->dlt", direction, columns, direction)
        wild &= np.abs(rest).max(axis=-1) > limit / 2  # beside one outlier another is suspected sooner
    found[wild] = True
    return found.T
