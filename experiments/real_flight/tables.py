"""Tables of a report on recorded flights: scores, folds, physical parameters, recipes and logs."""

import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np

from experiments.real_flight.models import physics_of
from experiments.real_flight.recipes import RECIPES
from experiments.real_flight.rows import QUANTITIES, SUM, cell_name, cells, least, pooled, score_labels
from experiments.reporting.results import Results
from experiments.reporting.stats import spread
from experiments.reporting.tables import EMPTY, Table, mean_over_seeds, spread_text, tabulate
from hybrid_jax.dynamics.terms import nominal_values
from hybrid_jax.dynamics.vehicle_file import VehicleModel
from hybrid_jax.flights.consistency import FAILS

VERDICTS = {"ok": "ok", "fails": "FAILS", "cannot tell": "?"}
SHORT = {
    "repeated samples": "repeats",
    "dp/dt against v": "dp/dt, v",
    "q̇ against ω": "q̇, ω",
    "v̇ against thrust along body z": "v̇, thrust",
    "specific force over thrust per mass": "force / thrust",
    "motor order against roll and pitch": "motor order",
    "spin against yaw": "spin",
    "lag of the gyro behind the motors": "gyro lag",
}


def score_tables(rows: Results, dt: float) -> list[Table]:
    """Make a table per horizon: a line per model, mode and N, over the test windows of all folds."""

    def title(label: str) -> str:
        at = (
            f"RMSE at step {label} ({int(label) * dt:.3g} s)" if label != SUM else "Mean error of steps 1 to 50, summed"
        )
        return f"{at}; {mean_over_seeds(rows)}, test windows of all folds"

    named = {cell_name(*cell): group for cell, group in cells(rows).items()}
    return [tabulate(title(label), named, _errors(label)) for label in score_labels(rows)]


def page_tables(rows: Results, choices: Mapping, model: VehicleModel, records: Sequence[Mapping]) -> list[Table]:
    """The tables of the page alone: folds, recipes, parameters and logs."""
    nominal = nominal_parameters(model)
    return [*fold_tables(rows), *choice_tables(choices), *parameter_tables(rows, nominal), *log_tables(records)]


def fold_tables(rows: Results) -> list[Table]:
    """With several folds, make a table of baselines and best hybrids in each, at each horizon."""
    folds, found = rows.unique("fold"), cells(rows)
    if len(folds) < 2:
        return []
    most = max(n for _, _, n in found)
    kept = [cell for cell in found if cell[0] in ("hold", "thrust") or (cell[0] == "hybrid" and cell[2] in (0, most))]
    lines = [
        (fold, cell_name(*cell), label, *(text(found[cell].where(fold=fold)) for text in _errors(label).values()))
        for fold in folds
        for cell in kept
        for label in score_labels(rows)
    ]
    return [Table("Fold by fold (mean ± std over seeds)", ("tested on", "model", "step", *_errors("")), lines)]


def parameter_tables(rows: Results, nominal: Mapping[str, float]) -> list[Table]:
    """Make a table of θ_p: nominal value, mean over folds and seeds, spread, and mean 95 % interval."""
    found = cells(rows.where(lambda row: bool(row["theta"])))
    most = max((n for _, _, n in found), default=0)
    kept = {cell: group for cell, group in found.items() if cell[1] != "scratch" and cell[2] in (0, most)}
    names = dict.fromkeys(name for group in kept.values() for row in group for name in row["theta"])
    lines = [
        (
            name,
            f"{nominal[name]:.3g}" if name in nominal else EMPTY,
            *(_parameter(rows, name) for rows in kept.values()),
        )
        for name in names
    ]
    title = "Physical parameters, SI units (mean ± std over folds and seeds; mean ends of the 95 % intervals)"
    return [Table(title, ("", "nominal", *(cell_name(*cell) for cell in kept)), lines)] if lines else []


def nominal_parameters(model: VehicleModel) -> dict[str, float]:
    """Nominal values of the learned parameters, entry by entry: "Ix", "k_rotors[2]", "aerodynamic_moment[0,1]"."""
    values = nominal_values(model.vehicle, model.terms)
    found = {}
    for name, value in physics_of(model, RECIPES["staged"]).theta().items():  # type: ignore
        array = np.reshape(values[name], np.shape(value))
        for place in np.ndindex(array.shape):
            found[f"{name}[{','.join(map(str, place))}]" if place else name] = float(array[place])
    return found


def choice_tables(choices: Mapping[str, Mapping[str, float]]) -> list[Table]:
    """Make a table of the recipes tried in each fold: validation error over that of the baseline."""
    if not choices:
        return []
    lines = [(fold, *(f"{error:.3f}" for error in errors.values()), least(errors)) for fold, errors in choices.items()]
    title = "Recipes: error on validation flights over that of thrust with frozen rates; the smallest is chosen"
    return [Table(title, ("tested on", *next(iter(choices.values())), "chosen"), lines)]


def log_tables(records: Sequence[Mapping[str, Any]]) -> list[Table]:
    """Make tables of the logs: length, gaps, changes, every check, and what would repair the failed ones."""
    if not records:
        return []
    lines, verdicts = [], []
    for record in records:
        name = f"{record['folder']}/{record['flight']}"
        counts = (str(record[key]) for key in ("gaps", "repeated_samples", "used_samples"))
        length = (str(record["samples"]), f"{record['seconds']:.1f}", f"{record['dt']:g}")
        lines.append((name, *length, *counts, "; ".join(record["done"]) or "none"))
        verdicts.append((name, *(f"{VERDICTS[c['verdict']]} {_value(c)}".strip() for c in record["checks"])))
    failed = [(flight, c["name"], _value(c), c["suggestion"]) for flight, c in failed_checks(records)]
    header = ("flight", "samples", "s", "dt [s]", "gaps", "repeated", "used samples", "changes")
    names = [str(SHORT.get(check["name"], check["name"])) for check in records[0]["checks"]]
    tables = [Table("Logs", header, lines), Table("Consistency of the raw logs", ("flight", *names), verdicts)]
    advice = Table("Failed checks, and how to repair them", ("flight", "check", "value", "suggestion"), failed)
    return [*tables, advice] if failed else tables


def failed_checks(records: Sequence[Mapping[str, Any]]) -> list[tuple[str, Mapping[str, Any]]]:
    """The checks that failed, each with its flight."""
    named = [(f"{record['folder']}/{record['flight']}", check) for record in records for check in record["checks"]]
    return [(flight, check) for flight, check in named if check["verdict"] == FAILS]


def _errors(label: str) -> dict[str, Callable[[Results], str]]:
    """The columns of a score: the error in each quantity."""

    def text(quantity: str, rows: Results) -> str:
        return spread_text(spread(pooled(rows, label, quantity)), ".4g", ".2g")

    return {f"{name.replace('_', ' ')} [{unit}]": partial(text, name) for name, unit in QUANTITIES.items()}


def _parameter(rows: Results, name: str) -> str:
    having = rows.where(lambda row: name in row["theta"])  # the recipe of another fold may not learn it
    if not len(having):
        return EMPTY
    values = having.numbers(lambda row: math.nan if row["theta"][name] is None else row["theta"][name])
    text = f"{values.mean():.3g}" + (f" ± {values.std(ddof=1):.1g}" if len(values) > 1 else "")
    ends = [(row["theta_interval"] or {}).get(name) for row in having]
    known = np.array([end for end in ends if end is not None and None not in end], float)
    text += f" [{known[:, 0].mean():.3g}, {known[:, 1].mean():.3g}]" if len(known) else ""
    folds, all_folds = (len(group.unique("fold")) for group in (having, rows))
    return text if folds == all_folds else f"{text} ({folds} of {all_folds} folds)"


def _value(check: Mapping[str, Any]) -> str:
    value = check["value"]
    known = isinstance(value, float | int) and math.isfinite(value)
    return f"{value:.2g}{' ms' if check['unit'] == 'ms' else ''}" if known else ""
