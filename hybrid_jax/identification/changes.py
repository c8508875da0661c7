"""Which parameters of an identified model changed between two sets of logs."""

import jax
import numpy as np
from jaxtyping import Float

from hybrid_jax.dynamics.base import AbstractVectorField
from hybrid_jax.estimation.least_squares import ravel_parameters
from hybrid_jax.estimation.uncertainty import named_parameters
from hybrid_jax.identification.fitting import Identified

ALIKE, LEAST = 0.03, 0.2  # share of a value by which flights of one vehicle differ; smallest share explained
REACH, SURE = 1.96, 1.5  # standard errors of an interval; smallest change in half-widths of the interval


def changes(
    field: AbstractVectorField, covariance: Float[np.ndarray, "p p"], found: Identified
) -> dict[str, tuple[float, float, float, float]]:
    """Return, for each changed parameter, the share of all changes that it explains, its value and its interval.

    Often only combinations of parameters are identifiable. Each parameter's change is fitted to the differences of all
    estimates by generalised least squares with their covariances; the best explanation is first.
    """
    with jax.enable_x64(True):  # in which models are identified
        before, restored = ravel_parameters(field)
        difference = np.asarray(ravel_parameters(found.field)[0]) - np.asarray(before)
        both = np.asarray(covariance) + np.asarray(found.covariance)
        identified = np.flatnonzero(np.isfinite(np.diagonal(both)))
        weight = np.linalg.pinv(both[np.ix_(identified, identified)])
        pulls, names = weight @ difference[identified], [*named_parameters(field)]
        shares = pulls**2 / np.diagonal(weight) / max(pulls @ difference[identified], 1e-30)
        changed = {}
        for place in np.argsort(-shares):
            shift, half = pulls[place] / weight[place, place], REACH / weight[place, place] ** 0.5
            shifts = (0.0, shift, shift - half, shift + half)
            moves = [np.eye(len(before))[identified[place]] * each for each in shifts]
            old, *new = (float(named_parameters(restored(before + move))[names[identified[place]]]) for move in moves)
            if shares[place] > LEAST and abs(shift) > SURE * half and abs(new[0] - old) > ALIKE * abs(old):
                changed[names[identified[place]]] = (float(shares[place]), *new)
    return changed
