"""The table of results, one row for each model tested in one fold, and the hypotheses about it.

Columns:

- fold: the flights tested on; model, mode: of MODELS and MODES; n_train: target windows trained on, 0 if none; seed.
- recipe: how the model was trained, empty for a baseline; val_loss, epochs, status: of its training.
- windows: number of test windows.
- scores: "10", "50", … (RMSE after so many intervals) and "sum" → quantity → error in the units of QUANTITIES.
- theta: learned physical parameters by name in SI units, None for a model without; theta_interval: their 95 % intervals
  [low, high], None without intervals.
"""

import math
from collections.abc import Mapping, Sequence

import numpy as np

from experiments.reporting import names
from experiments.reporting.claims import Claim, Inconclusive, Verdict, evaluate
from experiments.reporting.results import Results

QUANTITIES = {"position": "m", "velocity": "m/s", "rotation": "rad", "body_rates": "rad/s"}
MODELS = (names.HYBRID, names.NO_PHYSICS, names.PHYSICS_ONLY, names.LINEAR_RESIDUAL, names.THRUST, names.HOLD)
MODES = (names.FINE_TUNED, names.SCRATCH, names.ZERO_SHOT, names.SOURCE_ONLY, names.NOMINAL)
TAGS = ("fold", "model", "mode", "n_train", "seed")
OWN_LABELS = {names.LINEAR_RESIDUAL: "rigid body + linear residual", names.SOURCE_ONLY: "trained", names.NOMINAL: ""}
SUM = "sum"  # label of the nanodrone protocol's score; other labels are numbers of intervals

BASELINES = (names.LINEAR_RESIDUAL, names.THRUST, names.HOLD)

Cell = tuple[str, str, int]  # model, mode, n_train
Cells = Mapping[Cell, Results]


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


def verdicts(rows: Results) -> list[Verdict]:
    """Evaluate each hypothesis that the rows can answer, on the mean over seeds with folds pooled."""
    found = cells(rows)
    sizes = sorted({n for _, _, n in found} - {0})
    mode, most = ("fine_tuned", sizes[-1]) if sizes else ("source_only", 0)
    best = ("hybrid", mode, most)
    if best not in found:
        return []
    baselines = [cell for cell in found if cell[0] in BASELINES]
    rivals = [(model, mode, most) for model in ("no_physics", "physics_only")]
    claims = [
        _better("F1", best, baselines, "every simple baseline"),
        _better("F2", best, rivals, "no-physics and physics-only"),
    ]
    if sizes:
        few, scratch = (("hybrid", mode, sizes[0]) for mode in ("fine_tuned", "scratch"))
        claims += [
            _better("F3", few, [scratch], "the same model from scratch"),
            _better("F4", few, [("hybrid", "zero_shot", 0)], "the source's model as it is"),
        ]
    return evaluate(claims, found)


def _better(name: str, cell: Cell, others: Sequence[Cell], of: str) -> Claim[Cells]:
    """Claim that a cell has a smaller error than each of the others, in every quantity and at every horizon."""

    def predicate(found: Cells) -> tuple[bool, str]:
        known = [found[other] for other in others if other in found]
        if not known:
            raise Inconclusive("none of these was run")
        ratios = {
            f"{'summed' if label == SUM else f'step {label}'} {quantity}": max(
                _ratio(found[cell], other, label, quantity) for other in known
            )
            for label in score_labels(found[cell])
            for quantity in QUANTITIES
        }
        words = ", ".join(f"{where} {ratio:.3f}" for where, ratio in ratios.items())
        return all(ratio < 1 for ratio in ratios.values()), f"error over that of the best of them: {words}"

    return Claim(name, f"{cell_name(*cell)}, has smaller errors than {of} in every quantity", predicate)


def _ratio(rows: Results, others: Results, label: str, quantity: str) -> float:
    own, other = (float(np.mean(pooled(group, label, quantity))) for group in (rows, others))
    return own / other if math.isfinite(own) else math.inf
