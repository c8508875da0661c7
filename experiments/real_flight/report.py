"""Write the report, rows, figures and models of an experiment on recorded flights."""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

import hybrid_jax
from experiments.real_flight import scoring
from experiments.real_flight.figures import make_figures
from experiments.real_flight.folds import Fold, motion_of_logs
from experiments.real_flight.log_tables import log_tables
from experiments.real_flight.models import RECIPES
from experiments.real_flight.scoring import QUANTITIES, SUM, TAGS, cell_name, cells, pooled, score_labels
from experiments.real_flight.selection import Selection
from experiments.real_flight.study import Outputs
from experiments.real_flight.train import Experiment
from experiments.reporting import names, report
from experiments.reporting.claims import verdict_table
from experiments.reporting.plots import save_figures
from experiments.reporting.results import Results
from experiments.reporting.statistics import spread
from experiments.reporting.tables import EMPTY, Table, mean_over_seeds, print_tables, spread_text, tabulate
from experiments.runner.run_record import environment
from hybrid_jax.cli.choice import LEVEL
from hybrid_jax.estimation.uncertainty import named_parameters
from hybrid_jax.extrapolation import WARN, shares_outside
from hybrid_jax.flights.windows import flight_of

NOTES = (
    "Validation flights stop every training and are not among the N windows.",
    "An interval of θ_p takes the network as given and comes from windows of 10 steps that share no sample; it does "
    "not account for errors of the model.",
)


def write_report(name: str, experiment: Experiment, outputs: Outputs, console: Console) -> None:
    """Write models, figures and, last, the report; print its main tables."""
    out, rows, stages = experiment.config.out / name, outputs.table, experiment.stages
    save_models(out / "models", experiment, outputs)
    claims, nominal = scoring.verdicts(outputs.replicates), named_parameters(experiment.before.physics())
    shares = {log: (fold.name, each) for fold in outputs.folds for log, each in outside_of_training(fold).items()}
    main = [expected_table(outputs.selections), *score_tables(rows, experiment.dt)]
    main += [verdict_table(claims, "Hypotheses")] if claims else []
    records = [record for logs in experiment.logs.values() for record in logs.records]
    more = [*fold_tables(rows), choice_table(outputs.selections), *parameter_tables(rows, nominal)]
    parts = ("train", "validation", "test")
    extra = {
        "vehicle": {"before": asdict(experiment.before), "after": asdict(experiment.after)},
        "folds": [
            {"tested_on": fold.name} | {part: [flight_of(log) for log in getattr(fold, part)] for part in parts}
            for fold in outputs.folds
        ],
        "selections": [selected.described() for selected in outputs.selections],
        "outside": {flight: each for flight, (_, each) in shares.items()},
        "logs": {label: logs.records for label, logs in experiment.logs.items()},
    }
    figures = save_figures(out, make_figures(experiment, outputs))
    given = (experiment.config.described(), environment(stages.seconds), rows, claims, figures)
    head = introduction(name, experiment, outputs)
    tables = [*log_tables(records), main[0], outside_table(shares), *main[1:], *more]
    notes = [*stages.notes(), *NOTES]
    warned = warnings_of(shares)
    made = report.Report(name, *given, notes, extra, head, tables, conclusion=conclusion(outputs), warnings=warned)
    report.write_report(out, made)
    print_tables(console, [table for table in main if not (made.meaningless and table.verdicts)])
    for line in (*warned, *made.conclusions()):
        console.print(line, highlight=False, soft_wrap=True, style="yellow" * (line in warned), markup=False)
    console.print(
        f"Report, with folds, parameters and log checks: {out / report.HTML_NAME}", highlight=False, soft_wrap=True
    )


def conclusion(outputs: Outputs) -> list[str]:
    """What was chosen, and the position error to expect of it in the last fold, with the largest N."""
    if not outputs.selections:
        return []
    selected = outputs.selections[-1]
    place, label = max((i, label) for i, label in enumerate(selected.labels) if label != SUM)
    value, low, high = (end[place, 0] for end in selected.expected)
    interval = f" ({LEVEL:.0%} interval {low:.2g} to {high:.2g})" if np.isfinite(high) else ""
    chosen = ", ".join(dict.fromkeys(str(each.chosen) for each in outputs.selections))
    return [
        f"Chosen by flights left out of training: {chosen}.",
        f"After {label} steps of a flight not seen, expect a position RMSE of {value:.2g} m{interval}.",
    ]


def introduction(name: str, experiment: Experiment, outputs: Outputs) -> str:
    config, logs = experiment.config, experiment.logs
    flights = ", ".join(f"{len(each.logs)} {label}" for label, each in logs.items())
    of = ", ".join(f"{label} {sum(record['seconds'] for record in each.records):.0f} s" for label, each in logs.items())
    recipes = "\n".join(f"- recipe **{recipe}**: {RECIPES[recipe].about}" for recipe in config.tried)
    adapted = f"the source's flights, then on N windows of the target's ({config.draw}),"
    failed = sum(record["fails"] for each in logs.values() for record in each.records)
    anyway = (
        f"**{failed} checks of the logs failed, and --anyway went on: no number below counts until they pass.**\n\n"
    )
    return f"""{anyway if failed else ""}# {name}

Models are trained on {adapted if "target" in logs else "flights"} and predict \
held-out flights, open loop from every sample with the recorded rotor speeds.
{flights} flights ({of}{"; simulated" if config.simulated else ""}), in {len(outputs.folds)} folds by \
{config.folds_by}; {len(outputs.tests)} tests, {config.seeds} seeds.

- **hybrid**: a multirotor that learns {", ".join(experiment.before.learn)} (or what its recipe says), plus a small \
network of body-frame inputs
- **no-physics**: the same network with ṗ = v and the attitude's kinematics
- **physics-only**: the multirotor alone
- **rigid body + linear residual**: the nominal rigid body, and a linear map of state and input fitted to its residuals
- **chosen**: what flights left out of training in turn chose among baselines, physics-only and hybrids of each recipe
- **fine-tuned**: from the source's model; **scratch**: from nominal values; **zero-shot**: the source's model as it is
{recipes}

Errors are lengths of vectors, of rotation the angle. An RMSE is over all test windows."""


def save_models(folder: Path, experiment: Experiment, outputs: Outputs) -> None:
    """Save every trained model, and what was chosen, with what is known about it."""
    rows = {tuple(row[tag] for tag in TAGS): row for row in outputs.table}
    fields: dict[tuple[Any, ...], Any] = {
        (number, model, mode, trained.size(run), seed): trained.run(run)
        for (number, model, mode), trained in outputs.trained.items()
        for run, seed in enumerate(trained.seeds)
    }
    for (number, size, seed), each in outputs.chosen.items():
        fields[number, names.CHOSEN, names.FINE_TUNED if size else names.SOURCE_ONLY, size, seed] = each
    for (number, model, mode, size, seed), each in fields.items():
        tags = (outputs.folds[number].name, model, mode, size, seed)
        about = dict(zip(("tested_on", *TAGS[1:]), tags, strict=True)) | {"dt": experiment.dt}
        about |= {name: rows[tags][name] for name in ("recipe", "scores")}
        hybrid_jax.save(folder / f"fold{number}-{model}-{mode}-{size}-seed{seed}.npz", each, about)


def expected_table(selections: Sequence[Selection]) -> Table:
    """Make a table of the error to expect of what was chosen on a flight not seen, and of what came out."""

    def cells_of(selected: Selection, label: int) -> Iterator[str]:
        came_out, inside = np.array(list(selected.observed.values())), selected.inside()
        for quantity in range(len(QUANTITIES)):
            value, low, high = (end[label, quantity] for end in selected.expected)
            text = f"{value:.3g} [{low:.2g}, {high:.2g}]" if np.isfinite(high) else f"{value:.3g} [?]"
            tested = f": {np.median(came_out[:, label, quantity]):.3g}, {inside[label, quantity]} of {len(came_out)}"
            yield text + tested * bool(len(came_out))

    lines = [
        (each.fold, str(each.chosen), str(each.n_train or EMPTY), label, *cells_of(each, place))
        for each in selections
        for place, label in enumerate(each.labels)
    ]
    title = (
        f"Error to expect on a flight not seen [{LEVEL:.0%} interval], from those left out of training; after the "
        "colon what came out on test flights: median, and how many lie inside"
    )
    return Table(title, ("tested on", "chosen", "N", "step", *_errors("")), lines, labels=4)


def outside_of_training(fold: Fold) -> dict[str, dict[str, float]]:
    """Of each test flight, the shares of its samples outside what its fold was trained on."""
    known = motion_of_logs([*fold.train, *fold.validation])
    return {flight_of(log): shares_outside(known, motion_of_logs([log])) for log in fold.test}


def outside_table(shares: Mapping[str, tuple[str, Mapping[str, float]]]) -> Table:
    """Make a table of `outside_of_training` of all folds, by flight."""
    lines = [
        (flight, fold, *(f"{share:.0%}{' !' * (share > WARN)}" for share in each.values()))
        for flight, (fold, each) in shares.items()
    ]
    title = "Test flights against those trained on: share of samples outside the 1 to 99 % range; ! above 10 %"
    return Table(title, ("flight", "tested on", *next(iter(shares.values()))[1]), lines, labels=2)


def warnings_of(shares: Mapping[str, tuple[str, Mapping[str, float]]]) -> list[str]:
    """A line if test flights lie outside of what was trained on: for those no interval above may hold."""
    parts = []
    for name in next(iter(shares.values()))[1]:
        far = {flight: each[name] for flight, (_, each) in shares.items() if each[name] > WARN}
        if far:
            most = max(far, key=far.__getitem__)
            share = f"{far[most]:.0%} of its samples"
            parts.append(f"{name} in {len(far)} of {len(shares)} flights, most in {most} ({share})")
    beyond = "test flights are outside of what was trained on, so that the errors to expect may be too small"
    return [f"{beyond}: {'; '.join(parts)}"] * bool(parts)


def score_tables(rows: Results, dt: float) -> list[Table]:
    """Make a table per horizon: a line per model, mode and N, over the test windows of all folds."""
    titles = {label: f"RMSE at step {label} ({int(label) * dt:.3g} s)" for label in score_labels(rows) if label != SUM}
    if SUM in score_labels(rows):
        titles[SUM] = "Mean error of steps 1 to 50, summed"
    named, of = {cell_name(*cell): group for cell, group in cells(rows).items()}, mean_over_seeds(rows)
    return [tabulate(f"{at}; {of}, test windows of all folds", named, _errors(label)) for label, at in titles.items()]


def fold_tables(rows: Results) -> list[Table]:
    """With several folds, make a table of baselines and best hybrids in each, at each horizon."""
    folds, found = rows.unique("fold"), cells(rows)
    if len(folds) < 2:
        return []
    most = max(n for _, _, n in found)
    simple, learned = (names.HOLD, names.THRUST), (names.CHOSEN, names.HYBRID)
    kept = [cell for cell in found if cell[0] in simple or (cell[0] in learned and cell[2] in (0, most))]
    lines = [
        (fold, cell_name(*cell), label, *(text(found[cell].where(fold=fold)) for text in _errors(label).values()))
        for fold in folds
        for cell in kept
        for label in score_labels(rows)
    ]
    return [
        Table("Fold by fold (mean ± std over seeds)", ("tested on", "model", "step", *_errors("")), lines, labels=3)
    ]


def parameter_tables(rows: Results, nominal: Mapping[str, Any]) -> list[Table]:
    """Make a table of θ_p: nominal value, mean over folds and seeds, spread, and mean 95 % interval."""
    found = cells(rows.where(lambda row: bool(row["theta"])))
    most = max((n for _, _, n in found), default=0)
    kept = {cell: group for cell, group in found.items() if cell[1] != "scratch" and cell[2] in (0, most)}
    names = dict.fromkeys(name for group in kept.values() for row in group for name in row["theta"])
    lines = []
    for name in names:
        stated = f"{float(nominal[name]):.3g}" if name in nominal else EMPTY
        lines.append((name, stated, *(_parameter(rows, name) for rows in kept.values())))
    title = "Physical parameters, SI units (mean ± std over folds and seeds; mean ends of the 95 % intervals)"
    return [Table(title, ("", "nominal", *(cell_name(*cell) for cell in kept)), lines)] if lines else []


def choice_table(selections: Sequence[Selection]) -> Table:
    """Make a table of the candidates of each fold and N."""
    lines = []
    for selected in selections:
        for name, scores in selected.scores.items():
            ratios = np.exp(scores.mean(axis=1))
            worst = f"{ratios.max():.3f} ({selected.left_out[int(ratios.argmax())]})"
            mark = "yes" * (name == selected.chosen)
            mean = f"{np.exp(scores.mean()):.3f}"
            lines.append((selected.fold, str(selected.n_train or EMPTY), str(name), mean, worst, mark))
    title = "Candidates: error on flights left out of training over that of thrust with frozen rates (geometric mean)"
    return Table(title, ("tested on", "N", "candidate", "mean", "worst", "chosen"), lines, labels=3)


def _errors(label: str) -> dict[str, Callable[[Results], str]]:

    def text(quantity: str, rows: Results) -> str:
        return spread_text(spread(pooled(rows, label, quantity)), ".4g", ".2g")

    return {f"{name.replace('_', ' ')} [{unit}]": partial(text, name) for name, unit in QUANTITIES.items()}


def _parameter(rows: Results, name: str) -> str:
    having = rows.where(lambda row: name in row["theta"])  # the recipe of another fold may not learn it
    if not len(having):
        return EMPTY
    values = having.numbers(f"theta.{name}", missing=math.nan)
    text = f"{values.mean():.3g}" + (f" ± {values.std(ddof=1):.1g}" if len(values) > 1 else "")
    ends = [(row["theta_interval"] or {}).get(name) for row in having]
    known = np.array([end for end in ends if end is not None and None not in end], float)
    text += f" [{known[:, 0].mean():.3g}, {known[:, 1].mean():.3g}]" if len(known) else ""
    folds, all_folds = (len(group.unique("fold")) for group in (having, rows))
    return text if folds == all_folds else f"{text} ({folds} of {all_folds} folds)"
