"""What became of changing one choice at a time: trials, their table and figure for each choice, and their file."""

import csv
import io
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from experiments.paper.figures import STYLE, colour
from experiments.paper.rows import NAMES, Row
from experiments.paper.summary import Spread, by_domain, spread
from experiments.reporting.error_panels import Line, add_legend, draw_panel
from experiments.reporting.report_tables import Table, error_text, over_seeds


@dataclass(frozen=True)
class Trial:
    """One value of one choice.

    Attributes:
        choice: what was changed.
        value: what it was changed to.
        default: whether that is what the experiments do.
        source_mse: L_MSE of each seed's pre-trained model on the source's validation windows.
        rows: source-only and fine-tuned hybrids, in the target domains.
    """

    choice: str
    value: str
    default: bool
    source_mse: Sequence[float]
    rows: Sequence[Row]

    @property
    def name(self) -> str:
        """The value, the default one marked."""
        return f"{self.value} (default)" if self.default else self.value


def by_choice(trials: Iterable[Trial]) -> dict[str, list[Trial]]:
    """The trials of each choice, in their order."""
    trials = list(trials)
    return {choice: [t for t in trials if t.choice == choice] for choice in dict.fromkeys(t.choice for t in trials)}


def tables(trials: Sequence[Trial], truth: Mapping[str, Mapping[str, float]]) -> list[Table]:
    """A table for each choice, a line for each value: errors and biases of θ_p, mean ± std over seeds.

    Args:
        truth: domain → the true Ix, Iy [kg m²], k [N/(rad/s)²].
    """
    return [_table(choice, group, truth) for choice, group in by_choice(trials).items()]


@mpl.rc_context(STYLE)
def figure(trials: Sequence[Trial], title: str, floors: Mapping[str, float]) -> Figure:
    """The test errors of the fine-tuned models of one choice: a panel for each domain, a line for each value and N.

    Args:
        floors: domain → an error that no model can get below.

    Raises:
        ValueError: no trials.
    """
    if not trials:
        raise ValueError("trials must not be empty: there is nothing to draw")
    panels = {domain: _lines(trials, domain) for domain in by_domain(trials[0].rows)}
    count = max(len(lines) for lines in panels.values())
    drawn = Figure(figsize=(11, 1.9 + 0.32 * count), layout="constrained")
    row = drawn.subplots(1, len(panels), squeeze=False)[0]
    for axes, (domain, lines) in zip(row, panels.items(), strict=True):
        draw_panel(axes, lines, NAMES[domain].capitalize(), floors.get(domain, 0.0))
    for axes in row[1:]:
        axes.tick_params(labelleft=False)  # the lines are those of the first panel
    drawn.suptitle(title, fontsize=12)
    add_legend(drawn, any(row.test_mse is None for trial in trials for row in trial.rows))
    return drawn


def records(trials: Sequence[Trial]) -> list[dict[str, Any]]:
    """The rows of all trials as JSON values, each with its choice and value."""
    return [
        {"choice": trial.choice, "value": trial.value, "default": trial.default} | asdict(row)
        for trial in trials
        for row in trial.rows
    ]


def to_csv(trials: Sequence[Trial]) -> str:
    """The numbers of `records`, θ_p in columns of its own."""
    text = io.StringIO()
    found = [record | (record["theta"] or {}) for record in records(trials)]
    names = list(dict.fromkeys(name for record in found for name in record if name not in ("theta", "theta_interval")))
    writer = csv.DictWriter(text, names, extrasaction="ignore", lineterminator="\n")
    writer.writeheader()
    writer.writerows(found)
    return text.getvalue()


def _table(choice: str, trials: Sequence[Trial], truth: Mapping[str, Mapping[str, float]]) -> Table:
    """A line for each value, domain and N."""
    groups = by_domain(trials[0].rows).items()
    cells = [(domain, n) for domain, group in groups for n in sorted({row.n_train for row in group} - {0})]
    lines = [_line_of(trial, *cell, truth[cell[0]]) for cell in cells for trial in trials]
    header = ("target, N", choice, "source, validation", "source-only", "fine-tuned", "off in Ix, Iy, k [%]")
    return Table(f"{choice.capitalize()} (L_MSE, {over_seeds(trials[0].rows)}; less is better)", header, lines)


def _line_of(trial: Trial, domain: str, n: int, truth: Mapping[str, float]) -> list[str]:
    tuned, untuned = ([row for row in trial.rows if (row.domain, row.n_train) == (domain, size)] for size in (n, 0))
    return [
        f"{NAMES[domain]}, {n}",
        trial.name,
        error_text(spread(trial.source_mse)),
        error_text(spread([row.error for row in untuned])),
        error_text(spread([row.error for row in tuned])),
        ", ".join(_bias(tuned, name, value) for name, value in truth.items()),
    ]


def _bias(rows: Sequence[Row], name: str, truth: float) -> str:
    values = [np.inf if row.theta is None or row.theta[name] is None else row.theta[name] for row in rows]
    found: Spread = spread([100 * (value / truth - 1) for value in values])  # type: ignore[operator]
    return f"{found.mean:+.1f}"


def _lines(trials: Sequence[Trial], domain: str) -> list[Line]:
    sizes = sorted({row.n_train for trial in trials for row in trial.rows} - {0})
    lines = []
    for n in sizes:
        for trial in trials:
            errors = np.array([row.error for row in trial.rows if (row.domain, row.n_train) == (domain, n)])
            name = f"{trial.name}, N = {n}" if len(sizes) > 1 else trial.name
            tint, marked = (colour("hybrid"), "mean of the default") if trial.default else ("0.35", "")
            lines.append(Line(name, errors, tint, marked if n == sizes[0] else ""))
    return lines
