"""Write the report, rows and figure of an experiment on recorded flights."""

from collections.abc import Mapping, Sequence
from functools import partial
from itertools import product
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from experiments.real_flight.config import RealFlightConfig
from experiments.real_flight.study import ADAPTED, BASELINES, LEARNED, MODELS, Fold
from experiments.reporting import names, plots
from experiments.reporting.claims import Claim, Part, Undecided, Verdict, evaluate, every, verdict_table
from experiments.reporting.plots import METHODS, STYLE, Line, dots, subplots
from experiments.reporting.questions import QUESTIONS
from experiments.reporting.report import Report, rows_in
from experiments.reporting.results import Results
from experiments.reporting.statistics import Estimate, mean_interval, spread
from experiments.reporting.tables import EMPTY, Table, mean_over_seeds, spread_text, tabulate
from experiments.runner.stages import Stages
from hybrid_jax.adaptation.expectation import LEVEL
from hybrid_jax.cli.logs import Flights
from hybrid_jax.flights.windows import flight_of
from hybrid_jax.identification.learning import STEPS, UNITS

NAME = "real_flight"
LABELS = names.LABELS | {
    LEARNED: "hybrid-jax fit",
    ADAPTED: "hybrid-jax adapt",
    names.SCRATCH: "physics adapted from nominal",
    names.PHYSICS_ONLY: "its physics, no network",
    names.LINEAR_RESIDUAL: "rigid body + linear residual",
}
TINTS = {LEARNED: METHODS["fine-tuned"], ADAPTED: METHODS["adapted"]}
Cell = tuple[str, int]  # model, n_train


def write(
    config: RealFlightConfig, sets: Mapping[str, Flights], folds: Sequence[Fold], rows: Results, stages: Stages
) -> None:
    split = [{"train": [*map(flight_of, fold.train)], "test": [*map(flight_of, fold.test)]} for fold in folds]
    said = [f"{name}: {line}" for name, each in sets.items() for line in each.notes]
    flown = ", ".join(f"{len(each.logs)} {name} ({each.seconds:.0f} s)" for name, each in sets.items())
    stages.publish(NAME, config, rows, report, *said, folds=split, flown=flown)


def report(record: Mapping[str, Any]) -> Report:
    rows, config = rows_in(record), record["config"]
    found = cells(rows)
    best = max((cell for cell in found if cell[0] in (ADAPTED, LEARNED)), key=lambda cell: cell[1])
    claims = verdicts(found, best)
    tables = [expected_table(found), *score_tables(rows, found, config["dt"]), verdict_table(claims, "Hypotheses")]
    tables += [by_flight_table(found, best, max(config["horizon"])), parameter_table(found)]
    head = f"{QUESTIONS[NAME].head}\n\nFlights: {record['flown']}, in {len(record['folds'])} folds."
    tables = [table for table in tables if table.lines]
    return Report(record, draw(rows, config["dt"]), tables, conclusion(found, best, config["dt"]), claims, head)


def draw(rows: Results, dt: float) -> dict[str, tuple[Figure, str]]:
    return {"errors": (error_figure(rows, dt), "RMSE on held-out flights; a dot is a flight, or a fold and seed")}


@mpl.rc_context(STYLE)
def error_figure(rows: Results, dt: float) -> Figure:
    """Draw the RMSE at the end of the longest prediction, a panel per quantity, of models adapted to most windows."""
    horizon, most = max(int(name) for name in rows[0]["scores"] if name.isdigit()), max(rows["n_train"])
    groups = rows.where(n_train=(0, most)).group("model")
    named = {LABELS[model]: own for model, own in groups.items()}
    figure, panels = subplots(1.3 + 0.62 * len(named), 2, 2, sharey=True)
    for axes, (quantity, unit) in zip(panels.flat, UNITS.items(), strict=True):
        tints = [TINTS.get(model, plots.colour(model)) for model in groups]
        scores = [own.numbers(f"scores.{horizon}.{quantity}") for own in named.values()]
        dots(axes, [Line(*line) for line in zip(named, scores, tints, strict=True)])
        axes.set(title=quantity.replace("_", " "), xlabel=f"RMSE [{unit}]")
    more = f", adapted to {most} windows" * bool(most)
    about = "dot: a flight; bar: median; log scales; lower is better"
    return plots.titled(figure, f"Held-out flights after {horizon * dt:g} s{more} ({about})")


def cells(rows: Results) -> dict[Cell, Results]:
    return rows.sort(model=MODELS, n_train=None, seed=None).group("model", "n_train")


def label(model: str, n: int) -> str:
    return f"{LABELS[model]}{f', N = {n}' if n else ''}"


def pooled(rows: Results, horizon: str, quantity: str) -> np.ndarray:
    groups = rows.sort(seed=None).group("seed").values()
    return np.array([np.sqrt(np.mean(own.numbers(f"scores.{horizon}.{quantity}") ** 2)) for own in groups])


def conclusion(found: Mapping[Cell, Results], best: Cell, dt: float) -> list[str]:
    horizon = max(found[best][0]["scores"], key=int)
    errs = {cell: pooled(rows, horizon, "velocity").mean() for cell, rows in found.items()}
    simple = min((cell for cell in errs if cell[0] in BASELINES), key=errs.__getitem__)
    told = f"{label(*best)} has an error of {errs[best]:.3g} m/s after {int(horizon) * dt:.3g} s of a flight held out"
    return [f"{told}, {errs[best] / errs[simple]:.2f} times as much as the best baseline ({label(*simple)})."]


def expected_table(found: Mapping[Cell, Results]) -> Table:
    """Return the expected errors on unseen flights, the actual ones, and how many are in the interval."""
    lines = []
    for cell, rows in found.items():
        known = rows.where(lambda row: row["expected"] is not None)
        if len(known):
            texts = []
            for name in UNITS:
                told, came = (
                    np.exp(np.log(known.numbers(f"{of}.{name}")).mean()) for of in ("expected", f"scores.{STEPS}")
                )
                inside = int(sum(row["inside"][name] for row in known))
                texts.append(f"{told:.3g}: {came:.3g}, {inside} of {len(known)}")
            lines.append((label(*cell), *texts))
    title = (
        f"Error to expect after {STEPS} intervals: what came out, and how many flights lie in the {LEVEL:.0%} interval"
    )
    return Table(title, ("model", *_titles()), lines)


def score_tables(rows: Results, found: Mapping[Cell, Results], dt: float) -> list[Table]:
    """Return a table for each horizon, a line for each model and N."""

    def text(horizon: str, name: str, rows: Results) -> str:
        return spread_text(spread(pooled(rows, horizon, name)), ".4g", ".2g")

    named = {label(*cell): group for cell, group in found.items()}
    return [
        tabulate(
            f"RMSE after {int(horizon) * dt:.3g} s; {mean_over_seeds(rows)}, all test flights",
            named,
            {title: partial(text, horizon, name) for title, name in zip(_titles(), UNITS, strict=True)},
        )
        for horizon in rows[0]["scores"]
    ]


def by_flight_table(found: Mapping[Cell, Results], best: Cell, horizon: int) -> Table:
    """Return the best model's error on each flight over that with frozen rates, mean over seeds."""
    frozen = found[names.THRUST, 0].group("flight")
    lines = []
    for flight, own in found[best].group("flight").items():
        ratios = [
            pooled(own, str(horizon), name).mean() / pooled(frozen[flight], str(horizon), name).mean() for name in UNITS
        ]
        lines.append((flight, ", ".join(own.unique("chosen")), *(f"{ratio:.3g}" for ratio in ratios)))
    title = f"{label(*best)}: error after {horizon} intervals over that of thrust with frozen rates"
    return Table(title, ("flight", "chosen", *UNITS), lines, labels=2, folded=True)


def parameter_table(found: Mapping[Cell, Results]) -> Table:
    """Return θ_p: mean ± std over folds and seeds, and mean ends of the 95 % intervals."""
    told = {cell: rows for cell, rows in found.items() if rows[0]["theta"]}
    every_name = dict.fromkeys(name for rows in told.values() for row in rows for name in row["theta"])
    lines = []
    for name in every_name:
        texts = []
        for rows in told.values():
            having = rows.where(lambda row, name=name: name in row["theta"])
            values = having.numbers(f"theta.{name}", missing=np.nan)
            ends = [row["theta_interval"][name] for row in having if row["theta_interval"]]
            known = np.array([end for end in ends if None not in end], float)
            around = f" [{known[:, 0].mean():.3g}, {known[:, 1].mean():.3g}]" if len(known) else ""
            over = f" ± {values.std(ddof=1):.1g}" if len(values) > 1 else ""
            texts.append(f"{values.mean():.3g}{over}{around}" if len(values) else EMPTY)
        lines.append((name, *texts))
    title = "Physical parameters, SI units (mean ± std over flights and seeds; mean ends of the 95 % intervals)"
    return Table(title, ("", *(label(*cell) for cell in told)), lines, folded=True)


def verdicts(found: Mapping[Cell, Results], best: Cell) -> list[Verdict]:
    baselines = [cell for cell in found if cell[0] in BASELINES]
    claims = [
        _better("F1", best, baselines, "every simple baseline"),
        _better("F2", best, [(names.PHYSICS_ONLY, 0)], "the physics that was learned before"),
    ]
    if best[0] == ADAPTED:
        few = min(n for model, n in found if model == ADAPTED)
        claims += [
            _better("F3", (ADAPTED, few), [(names.SCRATCH, few)], "physics adapted from nominal"),
            _better("F4", (ADAPTED, few), [(LEARNED, 0)], "the model before the change"),
        ]
    return evaluate(claims, found)


def _better(name: str, cell: Cell, others: Sequence[Cell], of: str) -> Claim[Mapping[Cell, Results]]:
    """Claim that a cell has a smaller error than each of the others, in every quantity and at every horizon."""

    def predicate(found: Mapping[Cell, Results]) -> Part:
        known = [found[other] for other in others if other in found]
        if not known:
            raise Undecided("none of these was run")
        outcomes, words = [], []
        for horizon, quantity in product(found[cell][0]["scores"], UNITS):
            ratios = [_log_ratio(found[cell], rows, f"scores.{horizon}.{quantity}") for rows in known]
            outcomes += [ratio.below(0.0) for ratio in ratios]
            worst = Estimate(*np.exp(max(ratios, key=lambda ratio: ratio.value)))
            words.append(f"step {horizon} {quantity} {worst.text('.3f')}")
        return every(outcomes), f"error over that of the best of them: {', '.join(words)}"

    text = f"{label(*cell)}, has smaller errors than {of} in every quantity (95 % interval of the geometric mean ratio"
    return Claim(name, f"{text}, over test flights and, if there are several, seeds).", predicate)


def _log_ratio(rows: Results, others: Results, column: str) -> Estimate:
    """log(error / other error), of the same flight and seed; a baseline, without seeds, of the same flight."""
    theirs = {(row["flight"], row["seed"]): error for row, error in zip(others, others.numbers(column), strict=True)}
    pairs = [(row["flight"], row["seed"] if len(others.unique("seed")) > 1 else others[0]["seed"]) for row in rows]
    with np.errstate(all="ignore"):
        ratios = np.log(rows.numbers(column) / np.array([theirs[pair] for pair in pairs]))
    # One seed says nothing of others, and flights are what a claim is about.
    return mean_interval(ratios, rows["seed" if len(rows.unique("seed")) > 1 else "flight"], rows["flight"])


def _titles() -> list[str]:
    return [f"{name.replace('_', ' ')} [{unit}]" for name, unit in UNITS.items()]
