"""Tables of the paper's experiments: errors and ρ by N, the ranking with Table 2, θ_p, ablations; notes."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

from experiments.paper.claims import FEW
from experiments.paper.lanes import BANDS, MODELS, THETA, adapted_sizes, by_domain, cells, gain, method_label, ranked
from experiments.reporting import names
from experiments.reporting.claims import Verdict, every
from experiments.reporting.names import FINE_TUNED, HYBRID, NO_PHYSICS, PHYSICS_ONLY, SOURCE_ONLY, TARGET_ONLY, label
from experiments.reporting.results import Results, Row
from experiments.reporting.tables import EMPTY, Table, cross_table, mean_over_seeds, over_seeds, spread_text, tabulate

TUNED, PHYSICS = (HYBRID, FINE_TUNED, FEW), (PHYSICS_ONLY, FINE_TUNED, FEW)
SOLVED = names.LEAST_SQUARES, names.CONSTANT_DISTURBANCE  # not trained, though their rows have the mode
EXPERT = (names.EXPERT_AUGMENTATION, SOURCE_ONLY, 0)
UNITS = {"Ix": "kg m²", "Iy": "kg m²", "k": "N/(rad/s)²"}
# Errors printed in the paper: a mean with its std, or the smallest of ten seeds.
PAPER: Mapping[str, Mapping[tuple[str, str, int], tuple[float, float | None]]] = {
    names.PARAMETER_SHIFT: {TUNED: (3.26e-3, 2.66e-5), EXPERT: (3.68e-3, None), PHYSICS: (3.76e-3, None)},
    names.EXTERNAL_FORCE: {TUNED: (2.64e-3, 1.56e-4), EXPERT: (4.02e-3, None), PHYSICS: (4.53e-3, None)},
}

# Words for the choices of an ablation.
CHOICES = {
    "residual": "what the network reads → adds to",
    "weight": "weight of the regulariser",
    "form": "form of the regulariser",
    "norm": "normalisation in the network",
    "start": "initial θ_p",
    "source": "flights before the change",
    "noise": "sensor noise",
    "solver": "integrator",
}


def error_text(rows: Results) -> str:
    """0.0123 ± 0.0004, or ∞ with the count of infinite seeds and the median of all; a star marks capped runs."""
    return spread_text(rows.spread("test_mse")) + " *" * ("capped" in rows.unique("status"))


def capped(rows: Results) -> str:
    return "; *: the cap on epochs ended a run" * ("capped" in rows.unique("status"))


def rho_text(rows: Results) -> str:
    """0.912 ± 0.010, or −∞ as in `error_text`."""
    values = rows.spread(gain)
    if values.non_finite:
        return spread_text(values, ".3g")
    return spread_text(values, ".3f" if abs(values.mean) < 100 and not values.std >= 100 else ".2e")


def by_size(rows: Results) -> list[Table]:
    """Return test error and ρ in each domain: a line per N, a column per model and mode."""
    tables = []
    for place, group in _places(rows):
        trained, of = group.where(mode=(FINE_TUNED, TARGET_ONLY)), mean_over_seeds(group)
        # A source-only model is what fine-tuning starts from: it stands at the head of that column.
        modes = {FINE_TUNED: (FINE_TUNED, SOURCE_ONLY), TARGET_ONLY: (TARGET_ONLY,)}
        columns = {
            label(model) if model in SOLVED else label(model, mode): {"model": model, "mode": seen}
            for mode, seen in modes.items()
            for model in MODELS
            if len((trained or group).where(model=model, mode=seen))
        }
        for own, title, text in (
            (group, f"Test error{place} ({of}; less is better{capped(group)})", error_text),
            (trained, f"Improvement ρ over source-only{place} ({of}; 1 is perfect)", rho_text),
        ):
            sizes = own.sort(n_train=None).group("n_train")
            lines = {str(n) if n else f"none ({label(SOURCE_ONLY)})": cell for n, cell in sizes.items()}
            table = cross_table(title, lines, columns, text, "N, target trajectories")
            tables.append(table)
    return tables


def conclusion(rows: Results) -> list[str]:
    sentences = []
    for place, group in _places(rows):
        n = min(adapted_sizes(group), default=0)
        own = {cell: of_cell for cell, of_cell in ranked(group).items() if cell[2] in (0, n)}
        best = next(iter(own))
        if not math.isfinite(own[best].spread("test_mse").mean):
            continue
        sentence = f"With N = {n}{place}, {method_label(best)} has the smallest test error, {error_text(own[best])}"
        source = own.get((HYBRID, SOURCE_ONLY, 0))
        before = f"; without adaptation it is {spread_text(source.spread('test_mse'))}" if source else ""
        gone = {model: own.get((model, FINE_TUNED, n)) for model in (HYBRID, NO_PHYSICS)}
        words = [f"{label(model)} {100 * each.spread(gain).mean:.0f} %" for model, each in gone.items() if each]
        sentences += [f"{sentence}{before}."]
        sentences += [f"Of the source's error, fine-tuning removes: {', '.join(words)}."] * (len(words) == 2)
    return sentences


def meaning(verdicts: Sequence[Verdict]) -> list[str]:
    sentences = {
        True: "A model with physics in it, adapted to a little flight, predicts better than before the change and "
        "better than a network without physics: what the paper claims holds (C1, C2, C6).",
        False: "What the paper claims of the fine-tuned hybrid (C1, C2, C6) does not hold in these runs.",
        None: "These runs do not decide what the paper claims of the fine-tuned hybrid (C1, C2, C6).",
    }
    outcomes = [each.holds for each in verdicts if each.id in ("C1", "C2", "C6")]
    return [sentences[every(outcomes)]] if outcomes else []


def altitudes(rows: Results) -> list[Table]:
    """Return test errors by lowest altitude, at the smallest and largest N, and of the source models, if recorded."""
    own, sizes = rows.where(lambda row: "test_mse_low" in row), adapted_sizes(rows)
    if not len(own):
        return []
    groups = {
        (label(model), label(mode), str(n or EMPTY)): ("test_mse", group)
        for (model, mode, n), group in cells(own).items()
        if n in (0, *sizes[:1], *sizes[-1:])
    }
    home = own.where(lambda row: "source_mse" in row).group("model")
    groups |= {(label(model), "source-only, on source flights", EMPTY): ("source_mse", home[model]) for model in home}

    def text(column: str, group: Results) -> str:
        values = group.spread(column)
        return EMPTY if values.non_finite == values.count else spread_text(values)

    columns = {"": "all", **{f"_{name}": title for name, title in BANDS.items()}}
    lines = [(*key, *(text(f"{column}{end}", group) for end in columns)) for key, (column, group) in groups.items()]
    title = f"Test error by the lowest altitude of the window, and its floor ({mean_over_seeds(own)})"
    return [Table(title, ("model", "mode", "N", *columns.values()), lines, labels=3)]


def ranking(rows: Results) -> list[Table]:
    """Return a table per domain: a line per method, the smallest mean error first.

    A ratio is the paper's: the mean of the fine-tuned hybrid, the smallest error of any other method, over the smallest
    of fine-tuned physics-only (at the smallest N, if there are several).
    """
    header = ("method", "N", "smallest", "mean ± std", "ratio to physics-only's smallest", "paper", "paper's ratio")
    tables = []
    for domain, group in by_domain(rows).items():
        found, quoted = ranked(group), PAPER[domain]
        physics = min((cell for cell in found if cell[:2] == PHYSICS[:2]), default=None)
        best = math.nan if physics is None else found[physics].spread("test_mse").smallest
        lines = []
        for cell, of_cell in found.items():
            values, kind = of_cell.spread("test_mse"), "mean" if cell[:2] == TUNED[:2] else "smallest"
            own = _ratio(values.mean if kind == "mean" else values.smallest, best, kind)
            paper = EMPTY, EMPTY
            if cell in quoted:
                error, std = quoted[cell]
                shown = f"{error:.2e} (smallest)" if std is None else f"{error:.2e} ± {std:.2e}"
                paper = shown, _ratio(error, quoted[PHYSICS][0], kind)
            smallest = f"{values.smallest:.3g}".replace("inf", "∞")
            lines.append((method_label(cell), str(cell[2] or EMPTY), smallest, error_text(of_cell), own, *paper))
        of = f"experiment {[*PAPER].index(domain) + 1} of the paper; {over_seeds(group)}; less is better{capped(group)}"
        tables.append(Table(f"Test error, {label(domain)} ({of})", header, lines, labels=2))
    return tables


def _ratio(above: float, below: float, kind: str) -> str:
    return f"{above / below:.3g} ({kind})".replace("inf", "∞") if 0 < below < math.inf else EMPTY


def parameters(rows: Results, truth: Mapping[str, Any] | None) -> list[Table]:
    """θ_p of each cell, mean ± std over seeds, and the truth (or that by domain): a table per domain."""
    tables = []
    for place, group in _places(rows.where(lambda row: row["theta"] is not None)):
        true = truth if truth is None or set(truth) == set(THETA) else truth.get(group[0]["domain"])
        groups = {(label(m), label(mode), str(n or EMPTY)): cell for (m, mode, n), cell in cells(group).items()}
        columns = {f"{k} [{UNITS[k]}]": lambda cell, k=k: _theta_text(cell, k) for k in THETA}
        table = tabulate(f"Recovered physical parameters θ_p{place}", groups, columns, ("model", "mode", "N"))
        known = [] if true is None else [("truth", "", "", *(f"{true[name]:.5g}" for name in THETA))]
        tables.append(table._replace(lines=[*table.lines, *known]))
    return tables


def _theta_text(rows: Results, name: str) -> str:
    values = rows.spread(f"theta.{name}")
    if values.non_finite:
        return f"not finite in {values.non_finite} of {values.count} seeds"
    return spread_text(values, ".4g", ".2g")


def ablation_tables(rows: Results, truth: Mapping[str, Mapping[str, float]]) -> list[Table]:
    """Return for each choice errors and biases of θ_p, mean ± std over seeds: a line for each value, domain and N.

    The rows have the tags choice, value and default; `truth` is the true θ_p by domain.
    """

    def bias(rows: Results) -> str:
        true, tuned = truth[rows[0]["domain"]], rows.where(mode=FINE_TUNED)
        return ", ".join(f"{100 * (tuned.spread(f'theta.{k}').mean / true[k] - 1):+.1f}" for k in true)

    columns = {
        "source, validation": lambda group: spread_text(group.where(mode=SOURCE_ONLY).spread("val_mse")),
        "source-only": lambda group: error_text(group.where(mode=SOURCE_ONLY)),
        "fine-tuned": lambda group: error_text(group.where(mode=FINE_TUNED)),
        "off in Ix, Iy, k [%]": bias,
    }
    tables = []
    for choice, rows_of_choice in rows.group("choice").items():
        groups = {
            (f"{label(domain)}, {n}", value_label(group[0])): group.where(domain=domain, n_train=(0, n))
            for domain in by_domain(rows_of_choice)
            for n in adapted_sizes(rows_of_choice)
            for group in rows_of_choice.group("value").values()
        }
        words = CHOICES[choice].capitalize()
        title = f"{words} (L_MSE, {over_seeds(rows_of_choice)}; less is better{capped(rows_of_choice)})"
        tables.append(tabulate(title, groups, columns, ("target, N", CHOICES[choice])))
    return tables


def value_label(row: Row) -> str:
    return row["value"] + " (default)" * row["default"]


def run_notes(rows: Results) -> list[str]:
    """Return sentences on runs that reached the cap on epochs, that diverged, and with errors not finite."""
    diverged, several = rows.where(status="diverged"), len(rows.group("domain")) > 1
    epochs = ", ".join(map(str, sorted({*diverged["epochs"]})))
    when = f", in epoch {epochs}," if epochs else ""
    kinds = {
        "reached the cap on epochs before early stopping": rows.where(status="capped"),
        f"met a non-finite loss{when} and count with their best epoch before it": diverged,
        "have a test error that is not finite; it counts as infinite (∞)": rows.where(test_mse=None),
    }

    def counted(found: Results) -> str:
        return "; ".join(
            f"{label(model, mode)}, N = {n}{f', {label(domain)}' if several else ''}: {len(cell)}"
            for domain, group in by_domain(found).items()
            for (model, mode, n), cell in cells(group).items()
        )

    return [
        f"{len(found)} of {len(rows)} runs {words}" + (f" ({counted(found)})." if found else ".")
        for words, found in kinds.items()
    ]


def _places(rows: Results) -> list[tuple[str, Results]]:
    """Return each domain's rows with its part of a title, empty if there is only one."""
    groups = by_domain(rows)
    return [(f", {label(domain)}" if len(groups) > 1 else "", group) for domain, group in groups.items()]
