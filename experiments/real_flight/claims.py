"""Hypotheses about adaptation to recorded flight, and the verdicts of the results."""

import math
from collections.abc import Mapping, Sequence

import numpy as np

from experiments.real_flight.rows import QUANTITIES, SUM, Cell, cell_name, cells, pooled, score_labels
from experiments.reporting.claims import Claim, Inconclusive, Verdict, evaluate
from experiments.reporting.results import Results

BASELINES = ("linear_residual", "thrust", "hold")
Cells = Mapping[Cell, Results]


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
