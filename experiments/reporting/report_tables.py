"""The tables of a report as text, for a page and for a terminal alike."""

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

from experiments.paper.claims import Claim
from experiments.paper.rows import MODELS, MODES, NAMES, THETA, Row
from experiments.paper.summary import Spread, Summary, by_domain, grouped, spread, summarise


class Table(NamedTuple):
    """Header and lines of cells, all text, under a title."""

    title: str
    header: Sequence[str]
    lines: Sequence[Sequence[str]]


def headline(rows: Sequence[Row]) -> list[Table]:
    """L^T_MSE and ρ of each domain, mean ± std over seeds: a line per N, a column per model and mode."""
    return [table for place, group in _places(rows) for table in _headline(group, place)]


def verdicts(claims: Sequence[Claim]) -> Table:
    """A line per claim."""
    marks = {True: "✓ holds", False: "✗ fails", None: "– not judged"}
    lines = [(claim.id, claim.text, marks[claim.holds], claim.measured) for claim in claims]
    return Table("Claims of the paper", ("", "claim", "verdict", "measured"), lines)


def parameters(rows: Sequence[Row], truth: Mapping[str, Any] | None) -> list[Table]:
    """Ix, Iy, k of each cell that has them, mean ± std over seeds, and the truth: a table for each domain that has any.

    Args:
        truth: Ix, Iy, k, or these by domain.
    """
    tables = []
    for place, group in _places(rows):
        known = [row for row in group if row.theta is not None]
        if known:
            tables.append(_parameters(known, place, truth_in(truth, known[0].domain)))
    return tables


def truth_in(truth: Mapping[str, Any] | None, domain: str) -> Mapping[str, float] | None:
    """The true Ix, Iy, k in a domain, of these or of these by domain."""
    return truth if truth is None or set(truth) == set(THETA) else truth.get(domain)


def lane_notes(rows: Sequence[Row]) -> list[str]:
    """A sentence on runs that hit the epoch cap, one on those that diverged, one on errors that are not finite."""
    kinds: tuple[tuple[str, Callable[[Row], bool]], ...] = (
        ("hit the cap on epochs before early stopping ended them", lambda row: row.status == "capped"),
        (
            f"met a non-finite loss{_epochs_of_divergence(rows)} and count with their best epoch before it",
            lambda row: row.status == "diverged",
        ),
        ("have a test error that is not finite; it counts as infinite (∞)", lambda row: row.test_mse is None),
    )
    return [_tally(rows, words, chosen) for words, chosen in kinds]


def _epochs_of_divergence(rows: Sequence[Row]) -> str:
    epochs = sorted({row.epochs for row in rows if row.status == "diverged"})
    return f", in epoch {', '.join(map(str, epochs))}," if epochs else ""


def over_seeds(rows: Sequence[Row]) -> str:
    """How many seeds the numbers of these rows are over."""
    seeds = len({row.seed for row in rows})
    return f"{seeds} seeds" if seeds > 1 else "one seed"


def error_text(values: Spread) -> str:
    """1.23e-02 ± 4.5e-04, or ∞ with the count of seeds that make it so and the median of all."""
    if values.non_finite:
        return _infinite("∞", values, f"{values.median:.2e}")
    return f"{values.mean:.2e}" + ("" if math.isnan(values.std) else f" ± {values.std:.1e}")


def rho_text(values: Spread) -> str:
    """0.912 ± 0.010, or −∞ as in `error_text`."""
    if values.non_finite:
        return _infinite("−∞", values, f"{values.median:.3g}")
    form = ".3f" if abs(values.mean) < 100 and not values.std >= 100 else ".2e"
    return f"{values.mean:{form}}" + ("" if math.isnan(values.std) else f" ± {values.std:{form}}")


def _infinite(sign: str, values: Spread, median: str) -> str:
    median = median.replace("-inf", "−∞").replace("inf", "∞")
    return f"{sign} ({values.non_finite} of {values.count} seeds not finite, median {median})"


def _theta_text(rows: Sequence[Row], name: str, truth: float | None) -> str:
    """0.0398 ± 0.0004, 95 % ± 0.0006 (7 of 10 true): the spread over seeds, then the seeds' own intervals if any."""
    given = [row.theta[name] for row in rows if row.theta is not None]
    values = spread([math.inf if value is None else value for value in given])
    if values.non_finite:
        return f"not finite in {values.non_finite} of {values.count} seeds"
    text = f"{values.mean:.4g}" + ("" if math.isnan(values.std) else f" ± {values.std:.2g}")
    intervals = [row.theta_interval[name] for row in rows if row.theta_interval is not None]
    return f"{text}, {_interval_text(intervals, truth)}" if intervals else text


def _interval_text(intervals: Sequence[Any], truth: float | None) -> str:
    finite = [interval for interval in intervals if interval]
    if not finite:
        return "95 % interval not finite"
    some = "" if len(finite) == len(intervals) else f" in {len(finite)} of {len(intervals)} seeds"
    text = f"95 % ± {spread([(high - low) / 2 for low, high in finite]).mean:.2g}{some}"
    if truth is None:
        return text
    return f"{text} ({sum(low <= truth <= high for low, high in finite)} of {len(intervals)} true)"


def _places(rows: Sequence[Row]) -> list[tuple[str, list[Row]]]:
    """The rows of each domain, with what a title says of it: nothing where there is only one."""
    groups = by_domain(rows)
    return [(f", {NAMES[domain]}" if len(groups) > 1 else "", group) for domain, group in groups.items()]


def _headline(rows: Sequence[Row], place: str) -> list[Table]:
    trained = [row for row in rows if row.mode != "source_only"]
    seeds = over_seeds(rows)
    of = seeds if seeds == "one seed" else f"mean ± std over {seeds}"
    error, gain = f"Test error L^T_MSE{place} ({of}; less is better)", f"Improvement ρ over source-only{place} ({of}; "
    return [
        _by_size(rows, error, lambda cell: error_text(cell.mse)),
        _by_size(trained, f"{gain}1 is perfect)", lambda cell: rho_text(cell.rho)),
    ]


def _parameters(rows: Sequence[Row], place: str, truth: Mapping[str, float] | None) -> Table:
    lines = [
        (
            *(NAMES[model], NAMES[mode], str(n) if n else "–"),
            *(_theta_text(group, name, None if truth is None else truth[name]) for name in THETA),
        )
        for (model, mode, n), group in grouped(rows).items()
    ]
    if truth is not None:
        lines.append(("truth", "", "", *(f"{truth[name]:.5g}" for name in THETA)))
    units = ("Ix [kg m²]", "Iy [kg m²]", "k [N/(rad/s)²]")
    given = any(row.theta_interval is not None for row in rows)
    of = f" ({over_seeds(rows)}; 95 %: mean half-width of the seeds' intervals, how many are true)" if given else ""
    return Table(f"Recovered physical parameters θ_p{place}{of}", ("model", "mode", "N", *units), lines)


def _by_size(rows: Sequence[Row], title: str, text: Callable[[Summary], str]) -> Table:
    summaries = summarise(rows)
    columns = [(m, mode) for m in MODELS for mode in MODES[:2] if any(cell[:2] == (m, mode) for cell in summaries)]
    columns = columns or [(model, "fine_tuned") for model in MODELS if (model, "source_only", 0) in summaries]
    lines = []
    for n in sorted({cell[2] for cell in summaries}):
        # A source-only model is what fine-tuning starts from: it stands at the head of that column.
        modes = [mode if n else {"fine_tuned": "source_only"}.get(mode, "") for _, mode in columns]
        cells = [summaries.get((model, mode, n)) for (model, _), mode in zip(columns, modes, strict=True)]
        label = str(n) if n else "none (source-only)"
        lines.append((label, *("–" if cell is None else text(cell) for cell in cells)))
    names = [f"{NAMES[model]}, {NAMES[mode]}" for model, mode in columns]
    return Table(title, ("N, target trajectories", *names), lines)


def _tally(rows: Sequence[Row], words: str, chosen: Callable[[Row], bool]) -> str:
    found = [
        (place, Counter((row.model, row.mode, row.n_train) for row in group if chosen(row)))
        for place, group in _places(rows)
    ]
    places = [
        f"{NAMES[m]} {NAMES[mode]}, N = {n}{place}: {times}"
        for place, cells in found
        for (m, mode, n), times in cells.items()
    ]
    listed = f" ({'; '.join(places)})" if places else ""
    return f"{sum(cells.total() for _, cells in found)} of {len(rows)} runs {words}{listed}."
