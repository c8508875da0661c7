"""The tables of a report as text, for a page and for a terminal alike."""

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

from hybrid_jax.claims import Claim
from hybrid_jax.rows import MODELS, MODES, NAMES, THETA, Row
from hybrid_jax.summary import Spread, Summary, grouped, spread, summarise


class Table(NamedTuple):
    """Header and lines of cells, all text, under a title."""

    title: str
    header: Sequence[str]
    lines: Sequence[Sequence[str]]


def headline(rows: Sequence[Row]) -> list[Table]:
    """L^T_MSE and ρ, mean ± std over seeds: a line per N, a column per model and mode."""
    seeds, trained = len({row.seed for row in rows}), [row for row in rows if row.mode != "source_only"]
    of = f"mean ± std over {seeds} seeds" if seeds > 1 else "one seed"
    return [
        _by_size(rows, f"Test error L^T_MSE ({of}; less is better)", lambda cell: error_text(cell.mse)),
        _by_size(trained, f"Improvement ρ over source-only ({of}; 1 is perfect)", lambda cell: rho_text(cell.rho)),
    ]


def verdicts(claims: Sequence[Claim]) -> Table:
    """A line per claim."""
    marks = {True: "✓ holds", False: "✗ fails", None: "– not judged"}
    lines = [(claim.id, claim.text, marks[claim.holds], claim.measured) for claim in claims]
    return Table("Claims of the paper", ("", "claim", "verdict", "measured"), lines)


def parameters(rows: Sequence[Row], truth: Mapping[str, float] | None) -> Table | None:
    """Ix, Iy, k of each cell that has them, mean ± std over seeds, and the truth; None where no row has any."""
    lines = []
    for (model, mode, n), group in grouped(rows).items():
        thetas = [row.theta for row in group if row.theta is not None]
        if thetas:
            values = ([math.inf if theta[name] is None else theta[name] for theta in thetas] for name in THETA)
            cells = [_theta_text(spread([value or 0.0 for value in column])) for column in values]
            lines.append((NAMES[model], NAMES[mode], str(n) if n else "–", *cells))
    if not lines:
        return None
    if truth is not None:
        lines.append(("truth", "", "", *(f"{truth[name]:.5g}" for name in THETA)))
    units = ("Ix [kg m²]", "Iy [kg m²]", "k [N/(rad/s)²]")
    return Table("Recovered physical parameters θ_p", ("model", "mode", "N", *units), lines)


def lane_notes(rows: Sequence[Row]) -> list[str]:
    """A sentence on runs that hit the epoch cap, one on those that diverged, one on errors that are not finite."""
    kinds: tuple[tuple[str, Callable[[Row], bool]], ...] = (
        ("hit the cap on epochs before early stopping ended them", lambda row: row.status == "capped"),
        ("met a non-finite loss and count with their best epoch before it", lambda row: row.status == "diverged"),
        ("have a test error that is not finite; it counts as infinite (∞)", lambda row: row.test_mse is None),
    )
    return [_tally(rows, words, chosen) for words, chosen in kinds]


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


def _theta_text(values: Spread) -> str:
    if values.non_finite:
        return f"not finite in {values.non_finite} of {values.count} seeds"
    return f"{values.mean:.4g}" + ("" if math.isnan(values.std) else f" ± {values.std:.2g}")


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
    found = Counter((row.model, row.mode, row.n_train) for row in rows if chosen(row))
    places = [f"{NAMES[m]} {NAMES[mode]}, N = {n}: {times}" for (m, mode, n), times in found.items()]
    listed = f" ({'; '.join(places)})" if places else ""
    return f"{found.total()} of {len(rows)} runs {words}{listed}."
