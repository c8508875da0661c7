"""The tables of the paper's experiments: errors and ρ by N, the ranking beside Table 2, θ_p, ablations; notes."""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

from experiments.paper.claims import FEW
from experiments.paper.lanes import (
    CELL,
    DOMAINS,
    MODELS,
    THETA,
    Cell,
    by_domain,
    cells,
    gain,
    method_label,
    ranked,
)
from experiments.reporting.names import (
    EXPERT_AUGMENTATION,
    EXTERNAL_FORCE,
    FINE_TUNED,
    HYBRID,
    PARAMETER_SHIFT,
    PHYSICS_ONLY,
    SOURCE_ONLY,
    TARGET_ONLY,
    label,
)
from experiments.reporting.results import Results, Row
from experiments.reporting.stats import Spread, spread
from experiments.reporting.tables import (
    EMPTY,
    Table,
    cross_table,
    mean_over_seeds,
    over_seeds,
    spread_text,
    tabulate,
)

EXPERT, PHYSICS = (EXPERT_AUGMENTATION, SOURCE_ONLY, 0), (PHYSICS_ONLY, FINE_TUNED, FEW)
UNITS = {"Ix": "kg m²", "Iy": "kg m²", "k": "N/(rad/s)²"}


class Quoted(NamedTuple):
    """An error printed in the paper: a mean with its std, or the smallest of ten seeds."""

    error: float
    std: float | None = None


PAPER: Mapping[str, Mapping[Cell, Quoted]] = {
    PARAMETER_SHIFT: {
        (HYBRID, FINE_TUNED, FEW): Quoted(3.26e-3, 2.66e-5),
        EXPERT: Quoted(3.68e-3),
        PHYSICS: Quoted(3.76e-3),
    },
    EXTERNAL_FORCE: {
        (HYBRID, FINE_TUNED, FEW): Quoted(2.64e-3, 1.56e-4),
        EXPERT: Quoted(4.02e-3),
        PHYSICS: Quoted(4.53e-3),
    },
}


def error_text(rows: Results) -> str:
    """1.23e-02 ± 4.5e-04, or ∞ with the count of seeds that make it so and the median of all."""
    return spread_text(rows.spread("test_mse"), ".2e", ".1e")


def rho_text(rows: Results) -> str:
    """0.912 ± 0.010, or −∞ as in `error_text`."""
    values = rows.spread(gain)
    if values.non_finite:
        return spread_text(values, ".3g")
    return spread_text(values, ".3f" if abs(values.mean) < 100 and not values.std >= 100 else ".2e")


def by_size(rows: Results) -> list[Table]:
    """Test error and ρ in each domain: a line per N, a column per model and mode."""
    return [table for place, group in _places(rows) for table in _by_size(group, place)]


def _by_size(rows: Results, place: str) -> list[Table]:
    of = mean_over_seeds(rows)
    trained = rows.where(lambda row: row["mode"] != SOURCE_ONLY)
    pairs = {(row["model"], FINE_TUNED if row["mode"] == SOURCE_ONLY else row["mode"]) for row in trained or rows}
    columns = {
        # A source-only model is what fine-tuning starts from: it stands at the head of that column.
        label(model, mode): {"model": model, "mode": (FINE_TUNED, SOURCE_ONLY) if mode == FINE_TUNED else mode}
        for model in MODELS
        for mode in (FINE_TUNED, TARGET_ONLY)
        if (model, mode) in pairs
    }

    def table(rows: Results, title: str, text: Callable[[Results], str]) -> Table:
        groups = rows.sort(n_train=None).group("n_train")
        lines = {str(n) if n else f"none ({label(SOURCE_ONLY)})": group for n, group in groups.items()}
        return cross_table(title, lines, columns, text, "N, target trajectories")

    return [
        table(rows, f"Test error L^T_MSE{place} ({of}; less is better)", error_text),
        table(trained, f"Improvement ρ over source-only{place} ({of}; 1 is perfect)", rho_text),
    ]


def ranking(rows: Results) -> list[Table]:
    """A table per domain: a line per method, the smallest mean error first.

    A ratio is the paper's: the mean of the fine-tuned hybrid, the smallest error of any other method, over the smallest
    of fine-tuned physics-only (at the smallest N, if there are several).
    """
    return [_ranking(domain, group) for domain, group in by_domain(rows).items()]


def _ranking(domain: str, rows: Results) -> Table:
    found, quoted = ranked(rows), PAPER[domain]
    physics = min((cell for cell in found if cell[:2] == PHYSICS[:2]), default=None)
    below = math.nan if physics is None else found[physics].spread("test_mse").smallest

    def quote(cell: Cell) -> tuple[str, str]:
        if cell not in quoted:
            return EMPTY, EMPTY
        error, std = quoted[cell]
        shown = f"{error:.2e} (smallest)" if std is None else f"{error:.2e} ± {std:.2e}"
        return shown, _ratio_text(cell, error, quoted[PHYSICS].error)

    def line(cell: Cell, values: Spread) -> Sequence[str]:
        smallest = "∞" if math.isinf(values.smallest) else f"{values.smallest:.2e}"
        ratio = _ratio_text(cell, values.mean if _by_mean(cell) else values.smallest, below)
        n = str(cell[2]) if cell[2] else EMPTY
        return method_label(cell), n, smallest, error_text(found[cell]), ratio, *quote(cell)

    of = f"experiment {DOMAINS.index(domain) + 1} of the paper; {over_seeds(rows)}; less is better"
    header = ("method", "N", "smallest", "mean ± std", "ratio to physics-only's smallest", "paper", "paper's ratio")
    lines = [line(cell, group.spread("test_mse")) for cell, group in found.items()]
    return Table(f"Test error L^T_MSE, {label(domain)} ({of})", header, lines)


def _by_mean(cell: Cell) -> bool:
    """Whether the paper quotes the mean of a method; of the others it quotes the best seed."""
    return cell[:2] == (HYBRID, FINE_TUNED)


def _ratio_text(cell: Cell, above: float, below: float) -> str:
    if not 0 < below < math.inf:
        return EMPTY
    ratio = above / below
    return f"{'∞' if math.isinf(ratio) else f'{ratio:.3g}'} ({'mean' if _by_mean(cell) else 'smallest'})"


def parameters(rows: Results, truth: Mapping[str, Any] | None) -> list[Table]:
    """θ_p of each cell that has it, mean ± std over seeds, and the truth: a table for each domain.

    Args:
        truth: Ix, Iy [kg m²], k [N/(rad/s)²], or these by domain.
    """
    places = _places(rows.where(lambda row: row["theta"] is not None))
    return [_parameters(group, place, truth_in(truth, group[0]["domain"])) for place, group in places]


def truth_in(truth: Mapping[str, Any] | None, domain: str) -> Mapping[str, float] | None:
    """The true Ix, Iy, k in a domain, given these, or these by domain."""
    return truth if truth is None or set(truth) == set(THETA) else truth.get(domain)


def _parameters(rows: Results, place: str, truth: Mapping[str, float] | None) -> Table:
    groups = {(label(m), label(mode), str(n) if n else EMPTY): group for (m, mode, n), group in cells(rows).items()}
    true: Mapping[str, float | None] = dict.fromkeys(THETA) if truth is None else truth
    columns = {f"{k} [{UNITS[k]}]": lambda group, k=k: _theta_text(group, k, true[k]) for k in THETA}
    given = any(row["theta_interval"] is not None for row in rows)
    of = f" ({over_seeds(rows)}; 95 %: mean half-width of the seeds' intervals, how many are true)" if given else ""
    table = tabulate(f"Recovered physical parameters θ_p{place}{of}", groups, columns, ("model", "mode", "N"))
    if truth is None:
        return table
    return table._replace(lines=[*table.lines, ("truth", "", "", *(f"{truth[name]:.5g}" for name in THETA))])


def _theta_text(rows: Results, name: str, truth: float | None) -> str:
    """0.0398 ± 0.0004, 95 % ± 0.0006 (7 of 10 true): the spread over seeds, then the seeds' own intervals if any."""
    values = rows.spread(f"theta.{name}")
    if values.non_finite:
        return f"not finite in {values.non_finite} of {values.count} seeds"
    text = spread_text(values, ".4g", ".2g")
    intervals = [each[name] for each in rows["theta_interval"] if each is not None]
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


def ablation_tables(rows: Results, truth: Mapping[str, Mapping[str, float]]) -> list[Table]:
    """A table for each choice, a line for each value, domain and N: errors and biases of θ_p, mean ± std over seeds.

    Args:
        rows: with the tags choice, value and default.
        truth: domain → the true Ix, Iy [kg m²], k [N/(rad/s)²].
    """
    return [_ablation(choice, group, truth) for choice, group in rows.group("choice").items()]


def _ablation(choice: str, rows: Results, truth: Mapping[str, Mapping[str, float]]) -> Table:
    groups = {
        (f"{label(domain)}, {n}", value_label(group[0])): group.where(domain=domain, n_train=(0, n))
        for domain in by_domain(rows)
        for n in sorted({*rows["n_train"]} - {0})
        for group in rows.group("value").values()
    }

    def bias(rows: Results) -> str:
        true = truth[rows[0]["domain"]]
        tuned = rows.where(mode=FINE_TUNED)
        return ", ".join(f"{100 * (tuned.spread(f'theta.{k}').mean / true[k] - 1):+.1f}" for k in true)

    columns = {
        "source, validation": lambda group: spread_text(group.where(mode=SOURCE_ONLY).spread("val_mse"), ".2e", ".1e"),
        "source-only": lambda group: error_text(group.where(mode=SOURCE_ONLY)),
        "fine-tuned": lambda group: error_text(group.where(mode=FINE_TUNED)),
        "off in Ix, Iy, k [%]": bias,
    }
    title = f"{choice.capitalize()} (L_MSE, {over_seeds(rows)}; less is better)"
    return tabulate(title, groups, columns, ("target, N", choice))


def value_label(row: Row) -> str:
    """The value of an ablation, the default marked."""
    return f"{row['value']} (default)" if row["default"] else row["value"]


def run_notes(rows: Results) -> list[str]:
    """A sentence on runs that reached the cap on epochs, one on those that diverged, one on errors not finite."""
    epochs = sorted({row["epochs"] for row in rows if row["status"] == "diverged"})
    shown = f", in epoch {', '.join(map(str, epochs))}," if epochs else ""
    return [
        _tally(rows, "reached the cap on epochs before early stopping", lambda row: row["status"] == "capped"),
        _tally(
            rows,
            f"met a non-finite loss{shown} and count with their best epoch before it",
            lambda row: row["status"] == "diverged",
        ),
        _tally(
            rows,
            "have a test error that is not finite; it counts as infinite (∞)",
            lambda row: row["test_mse"] is None,
        ),
    ]


def _tally(rows: Results, words: str, chosen: Callable[[Row], bool]) -> str:
    found = rows.where(chosen)
    counted = [
        f"{label(model, mode)}, N = {n}{place}: {len(cell)}"
        for place, group in _places(rows)
        for (model, mode, n), cell in group.where(chosen).group(*CELL).items()
    ]
    return f"{len(found)} of {len(rows)} runs {words}" + (f" ({'; '.join(counted)})." if counted else ".")


def _places(rows: Results) -> list[tuple[str, Results]]:
    """The rows of each domain, with its part of a title: empty where there is only one."""
    groups = by_domain(rows)
    return [(f", {label(domain)}" if len(groups) > 1 else "", group) for domain, group in groups.items()]
