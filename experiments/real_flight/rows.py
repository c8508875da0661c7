"""The table of results: one row for each model tested in one fold.

Columns:

- fold: the flights tested on; model, mode: of MODELS and MODES; n_train: target windows trained on, 0 if none; seed.
- recipe: how the model was trained, empty for a baseline; val_loss, epochs, status: of its training.
- windows: number of test windows.
- scores: "10", "50", … (RMSE after so many intervals) and "sum" → quantity → error in the units of QUANTITIES.
- theta: learned physical parameters by name in SI units, None for a model without; theta_interval: their 95 % intervals
  [low, high], None without intervals.
"""

import math
from collections.abc import Mapping

import numpy as np

from experiments.reporting import names
from experiments.reporting.results import Results

QUANTITIES = {"position": "m", "velocity": "m/s", "rotation": "rad", "body_rates": "rad/s"}
MODELS = (names.HYBRID, names.NO_PHYSICS, names.PHYSICS_ONLY, names.LINEAR_RESIDUAL, names.THRUST, names.HOLD)
MODES = (names.FINE_TUNED, names.SCRATCH, names.ZERO_SHOT, names.SOURCE_ONLY, names.NOMINAL)
TAGS = ("fold", "model", "mode", "n_train", "seed")
OWN_LABELS = {names.LINEAR_RESIDUAL: "rigid body + linear residual", names.SOURCE_ONLY: "trained", names.NOMINAL: ""}
SUM = "sum"  # label of the nanodrone protocol's score; other labels are numbers of intervals

Cell = tuple[str, str, int]  # model, mode, n_train


def cells(rows: Results) -> dict[Cell, Results]:
    """Group rows over folds and seeds, in the order of MODELS, MODES and n_train."""
    return rows.sort(model=MODELS, mode=MODES, n_train=None, seed=None).group("model", "mode", "n_train")


def cell_name(model: str, mode: str, n_train: int = 0) -> str:
    """Label a model, what was done with it, and with how many windows."""
    words = [(names.LABELS | OWN_LABELS).get(key, key) for key in (model, mode)]
    return ", ".join(filter(None, [*words, f"N = {n_train}" if n_train else ""]))


def score_labels(rows: Results) -> list[str]:
    """The labels of the scores, such as "10" and "sum"."""
    return list(rows[0]["scores"]) if len(rows) else []


def pooled(rows: Results, label: str, quantity: str) -> np.ndarray:
    """Compute the error of each seed over the test windows of all folds together."""
    power = 1 if label == SUM else 2  # means are averaged as they are, root mean squares as squares

    def one(own: Results) -> float:
        weights, errors = own.numbers("windows"), own.numbers(f"scores.{label}.{quantity}")
        return float((weights @ errors**power / weights.sum()) ** (1 / power))

    return np.array([one(own) for own in rows.sort(seed=None).group("seed").values()])


def least(errors: Mapping[str, float]) -> str:
    """The name with the smallest finite error, the first of equal ones."""
    return min(errors, key=lambda name: (not math.isfinite(errors[name]), errors[name]))
