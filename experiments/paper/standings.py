"""The tables of a comparison: every method on each domain, beside what the paper says of it (Table 2)."""

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

from experiments.paper.claims import FEW
from experiments.paper.rows import DOMAINS, NAMES, Row
from experiments.paper.summary import Cell, Spread, by_domain, method, ranked, spread
from experiments.reporting.report_tables import Table, error_text, over_seeds

HYBRID, EXPERT = ("hybrid", "fine_tuned", FEW), ("expert_augmentation", "source_only", 0)
PHYSICS = ("physics_only", "fine_tuned", FEW)


class Quoted(NamedTuple):
    """An error that the paper prints: a mean with its std, or the smallest of ten seeds."""

    error: float
    std: float | None = None

    def text(self) -> str:
        """As its table has it."""
        return f"{self.error:.2e} (smallest)" if self.std is None else f"{self.error:.2e} ± {self.std:.2e}"


PAPER: Mapping[str, Mapping[Cell, Quoted]] = {
    "parameter_shift": {HYBRID: Quoted(3.26e-3, 2.66e-5), EXPERT: Quoted(3.68e-3), PHYSICS: Quoted(3.76e-3)},
    "external_force": {HYBRID: Quoted(2.64e-3, 1.56e-4), EXPERT: Quoted(4.02e-3), PHYSICS: Quoted(4.53e-3)},
}


def standings(rows: Sequence[Row]) -> list[Table]:
    """For each domain a line per method, the smallest mean error first.

    A ratio is the paper's: the mean of the fine-tuned hybrid, the smallest error of any other method, over the smallest
    of fine-tuned physics-only (at the smallest N, if there are several).
    """
    return [_table(domain, group) for domain, group in by_domain(rows).items()]


def _table(domain: str, rows: Sequence[Row]) -> Table:
    errors = {cell: spread([row.error for row in group]) for cell, group in ranked(rows).items()}
    reference = min((cell for cell in errors if cell[:2] == PHYSICS[:2]), default=None)
    below = math.nan if reference is None else errors[reference].smallest
    experiment = f"experiment {DOMAINS.index(domain) + 1} of the paper"
    title = f"Test error L^T_MSE, {NAMES[domain]} ({experiment}; {over_seeds(rows)}; less is better)"
    header = ("method", "N", "smallest", "mean ± std", "ratio to physics-only's smallest", "paper", "paper's ratio")
    return Table(title, header, [_line(domain, cell, values, below) for cell, values in errors.items()])


def _line(domain: str, cell: Cell, values: Spread, below: float) -> Sequence[str]:
    quoted, physics = PAPER[domain].get(cell), PAPER[domain][PHYSICS]
    return (
        method(cell),
        str(cell[2]) if cell[2] else "–",
        "∞" if math.isinf(values.smallest) else f"{values.smallest:.2e}",
        error_text(values),
        _ratio_text(cell, values.mean if _by_mean(cell) else values.smallest, below),
        "–" if quoted is None else quoted.text(),
        "–" if quoted is None else _ratio_text(cell, quoted.error, physics.error),
    )


def _by_mean(cell: Cell) -> bool:
    """Whether the paper has a method stand with its mean; the others stand with the best of their seeds."""
    return cell[:2] == HYBRID[:2]


def _ratio_text(cell: Cell, above: float, below: float) -> str:
    if not 0 < below < math.inf:
        return "–"
    ratio = above / below
    return f"{'∞' if math.isinf(ratio) else f'{ratio:.3g}'} ({'mean' if _by_mean(cell) else 'smallest'})"
