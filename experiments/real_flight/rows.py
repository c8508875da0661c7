"""One row for each model tested on recorded flights of one fold, and what rows say together."""

import csv
import io
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

QUANTITIES = {"position": "m", "velocity": "m/s", "rotation": "rad", "body_rates": "rad/s"}
MODELS = ("hybrid", "no_physics", "physics_only", "linear_residual", "thrust", "hold")
MODES = ("fine_tuned", "scratch", "zero_shot", "source_only", "nominal")
NAMES = {
    "hybrid": "hybrid",
    "no_physics": "no-physics",
    "physics_only": "physics-only",
    "linear_residual": "rigid body + linear residual",
    "thrust": "thrust, rates frozen",
    "hold": "hold the state",
    "fine_tuned": "fine-tuned",
    "scratch": "scratch",
    "zero_shot": "zero-shot",
    "source_only": "trained",
    "nominal": "",
}
SUM = "sum"  # the label of the nanodrone protocol's score; the other labels are numbers of intervals

Cell = tuple[str, str, int]  # model, mode, n_train
Scores = Mapping[str, Mapping[str, float | None]]


@dataclass(frozen=True)
class FlightRow:
    """The result of one trained model, or of a baseline, in one fold. A number that is not finite is None.

    Attributes:
        fold: the flights that it was tested on.
        model, mode: of MODELS and MODES.
        n_train: target windows trained on; 0 where there were none.
        seed: fixes initialisation, minibatch order and the windows drawn.
        recipe: how it was trained; empty for a baseline.
        windows: test windows.
        scores: "10", "50", … (RMSE after so many intervals) and "sum" → quantity → error, in `QUANTITIES`' units.
        val_loss: of its last stage's best epoch, on the validation windows.
        epochs, status: of its training.
        theta: learned physical parameters by name, SI units; None for a model without.
        theta_interval: [low, high] of the 95 % interval of each; None where there are none.
    """

    fold: str
    model: str
    mode: str
    n_train: int
    seed: int
    recipe: str
    windows: int
    scores: Scores
    val_loss: float | None = None
    epochs: int = 0
    status: str = "ok"
    theta: Mapping[str, float | None] | None = None
    theta_interval: Mapping[str, Sequence[float | None] | None] | None = None

    def error(self, label: str, quantity: str) -> float:
        """The score with which the row counts: infinite if it was not finite."""
        value = self.scores[label][quantity]
        return math.inf if value is None else value

    @property
    def cell(self) -> Cell:
        """What is the same over folds and seeds."""
        return self.model, self.mode, self.n_train


def cells(rows: Iterable[FlightRow]) -> dict[Cell, list[FlightRow]]:
    """The rows of each cell, in the order of MODELS, MODES and n_train."""
    found: dict[Cell, list[FlightRow]] = {}
    for row in sorted(rows, key=lambda row: (MODELS.index(row.model), MODES.index(row.mode), row.n_train, row.seed)):
        found.setdefault(row.cell, []).append(row)
    return found


def cell_name(cell: Cell) -> str:
    """For people: the model, what was done with it, and with how many windows."""
    model, mode, n = cell
    return ", ".join(word for word in (NAMES[model], NAMES[mode], f"N = {n}" if n else "") if word)


def pooled(rows: Sequence[FlightRow], label: str, quantity: str) -> np.ndarray:
    """The error of each seed over the test windows of all folds together."""
    seeds = sorted({row.seed for row in rows})
    power = 1 if label == SUM else 2  # means add up as they are, root mean squares as squares

    def one(seed: int) -> float:
        own = [row for row in rows if row.seed == seed]
        weights = np.array([row.windows for row in own], float)
        errors = np.array([row.error(label, quantity) for row in own])
        return float((weights @ errors**power / weights.sum()) ** (1 / power))

    return np.array([one(seed) for seed in seeds])


def least(errors: Mapping[str, float]) -> str:
    """The name with the least error, the first of equal ones; what is not finite is taken only if nothing is."""
    return min(errors, key=lambda name: (not math.isfinite(errors[name]), errors[name]))


def finite(value: float) -> float | None:
    """The number, or None where it is not finite."""
    return float(value) if math.isfinite(value) else None


def to_csv(rows: Sequence[FlightRow]) -> str:
    """The rows as CSV: a column for each score, such as `10 velocity`, and for each physical parameter."""
    plain = [field.name for field in fields(FlightRow) if field.name not in ("scores", "theta", "theta_interval")]
    labels = [(label, quantity) for label in rows[0].scores for quantity in QUANTITIES] if rows else []
    names = list(dict.fromkeys(name for row in rows for name in row.theta or ()))
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([*plain, *(f"{label} {quantity}" for label, quantity in labels), *names])
    for row in rows:
        own = [getattr(row, name) for name in plain]
        scores = [_shown(row.scores[label][quantity]) for label, quantity in labels]
        writer.writerow([*own, *scores, *(_shown((row.theta or {}).get(name, "")) for name in names)])
    return text.getvalue()


def by_name(theta: Mapping[str, Any], read: Callable[[Any], Any]) -> dict[str, Any]:
    """Parameters entry by entry: "Ix" as it is, "k_rotors[2]" and "aerodynamic_moment[0,1]" from arrays."""
    found = {}
    for name, value in theta.items():
        array = np.asarray(value)
        for place in np.ndindex(array.shape):
            found[f"{name}[{','.join(map(str, place))}]" if place else name] = read(array[place])
    return found


def _shown(value: float | str | None) -> float | str:
    return "null" if value is None else value
