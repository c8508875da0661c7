"""What should come of adapting to recorded flight, each held against the numbers and never bent."""

import math
from collections.abc import Sequence

import numpy as np

from experiments.paper.claims import Claim
from experiments.real_flight.rows import QUANTITIES, SUM, Cell, FlightRow, cell_name, cells, pooled

BASELINES = ("linear_residual", "thrust", "hold")


def flight_claims(rows: Sequence[FlightRow]) -> list[Claim]:
    """One claim with its verdict for each question that the rows can answer; mean over seeds, folds pooled."""
    found = cells(rows)
    sizes = sorted({n for _, _, n in found} - {0})
    best: Cell = ("hybrid", "fine_tuned", sizes[-1]) if sizes else ("hybrid", "source_only", 0)
    if best not in found:
        return []
    own = [cell for cell in found if cell[0] in BASELINES]
    rivals = [cell for cell in found if cell[:2] in {("no_physics", best[1]), ("physics_only", best[1])}]
    claims = [
        _better("F1", best, own, found, "every simple baseline"),
        _better("F2", best, [cell for cell in rivals if cell[2] == best[2]], found, "no-physics and physics-only"),
    ]
    if sizes:
        few: Cell = ("hybrid", "fine_tuned", sizes[0])
        claims += [
            _better("F3", few, [("hybrid", "scratch", sizes[0])], found, "the same model from scratch"),
            _better("F4", few, [("hybrid", "zero_shot", 0)], found, "the source's model as it is"),
        ]
    return claims


def _better(name: str, cell: Cell, others: Sequence[Cell], found, of: str) -> Claim:
    """Less error than each of the others, in every quantity and at every horizon."""
    text = f"{cell_name(cell)}, errs less than {of} in every quantity"
    others = [other for other in others if other in found]
    if not others:
        return Claim(name, text, None, "none of these was run")
    ratios = {
        f"{_at(label)} {quantity}": max(_ratio(found[cell], found[other], label, quantity) for other in others)
        for label in found[cell][0].scores
        for quantity in QUANTITIES
    }
    words = [f"{where} {ratio:.3f}" for where, ratio in ratios.items()]
    holds = all(ratio < 1 for ratio in ratios.values())
    return Claim(name, text, holds, f"error over that of the best of them: {', '.join(words)}")


def _ratio(rows: Sequence[FlightRow], others: Sequence[FlightRow], label: str, quantity: str) -> float:
    own, other = (float(np.mean(pooled(group, label, quantity))) for group in (rows, others))
    return own / other if math.isfinite(own) else math.inf


def _at(label: str) -> str:
    return "summed" if label == SUM else f"step {label}"
