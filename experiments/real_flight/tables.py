"""The tables of a report on recorded flights as text: scores, folds, physical parameters, and the logs themselves."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from experiments.real_flight.rows import QUANTITIES, SUM, FlightRow, cell_name, cells, least, pooled
from experiments.reporting.report_tables import Table

VERDICTS = {"ok": "ok", "fails": "FAILS", "cannot tell": "?"}
SHORT = {
    "gaps": "gaps",
    "repeated samples": "repeats",
    "dp/dt against v": "dp/dt, v",
    "q̇ against ω": "q̇, ω",
    "v̇ against thrust along body z": "v̇, thrust",
    "specific force over thrust per mass": "force / thrust",
    "motor order against roll and pitch": "motor order",
    "spin against yaw": "spin",
    "lag of the gyro behind the motors": "gyro lag",
}


def score_tables(rows: Sequence[FlightRow], dt: float) -> list[Table]:
    """A table for each horizon: a line per model, mode and N; all folds' windows together, mean ± std over seeds."""
    return [_scores(rows, label, dt) for label in rows[0].scores] if rows else []


def fold_tables(rows: Sequence[FlightRow]) -> list[Table]:
    """Where there are several folds: what the baselines and the best-taught hybrids did in each, at each horizon."""
    folds = list(dict.fromkeys(row.fold for row in rows))
    if len(folds) < 2:
        return []
    found = cells(rows)
    most = max(n for _, _, n in found)
    kept = [cell for cell in found if cell[0] in ("hold", "thrust") or (cell[0] == "hybrid" and cell[2] in (0, most))]
    lines = [
        (fold, cell_name(cell), label, *_errors([row for row in found[cell] if row.fold == fold], label))
        for fold in folds
        for cell in kept
        for label in found[cell][0].scores
    ]
    return [Table("Fold by fold (mean ± std over seeds)", ("tested on", "model", "step", *_units()), lines)]


def parameter_tables(rows: Sequence[FlightRow], nominal: Mapping[str, float]) -> list[Table]:
    """θ_p of the hybrid and of physics alone: the mean over folds and seeds, their spread, and the mean interval.

    Args:
        nominal: of each parameter by name, as in the rows.
    """
    found = {cell: group for cell, group in cells(rows).items() if any(row.theta for row in group)}
    most = max((n for _, _, n in found), default=0)
    kept = [cell for cell in found if cell[1] != "scratch" and cell[2] in (0, most)]
    names = list(dict.fromkeys(name for cell in kept for row in found[cell] for name in row.theta or ()))
    lines = [(name, _number(nominal.get(name)), *(_parameter(found[cell], name) for cell in kept)) for name in names]
    if not lines:
        return []
    title = "Physical parameters, SI units (mean ± std over folds and seeds; mean ends of the 95 % intervals)"
    return [Table(title, ("", "nominal", *map(cell_name, kept)), lines)]


def choice_tables(choices: Mapping[str, Mapping[str, float]]) -> list[Table]:
    """By which recipe a fold was learned: of each candidate, the error on validation flights over the baseline's."""
    if not choices:
        return []
    names = list(next(iter(choices.values())))
    lines = [(fold, *(f"{error:.3f}" for error in errors.values()), least(errors)) for fold, errors in choices.items()]
    title = "Recipes: error on validation flights over that of thrust with frozen rates; the least was taken"
    return [Table(title, ("tested on", *names, "taken"), lines)]


def log_tables(records: Sequence[Mapping[str, Any]]) -> list[Table]:
    """What is known of each log: its length, gaps, what was done, and every check with its verdict."""
    if not records:
        return []
    names: list[str] = [check["name"] for check in records[0]["checks"]]
    flights = [(f"{record['folder']}/{record['flight']}", record) for record in records]
    lines = [
        (name, str(record["samples"]), f"{record['seconds']:.1f}", f"{record['dt']:g}", str(record["gaps"]),
         str(record["repeated_samples"]), str(record["used_samples"]), "; ".join(record["done"]) or "nothing")
        for name, record in flights
    ]  # fmt: skip
    logs = Table(
        "Logs", ("flight", "samples", "s", "dt [s]", "gaps", "repeated", "samples in use", "what was done"), lines
    )
    verdicts = [(name, *map(_verdict, record["checks"])) for name, record in flights]
    checks = Table(
        "Consistency of each log, as it was read", ("flight", *(SHORT.get(name, name) for name in names)), verdicts
    )
    advice = [
        (name, check["name"], _value(check), check["suggestion"])
        for name, record in flights
        for check in record["checks"]
        if check["verdict"] == "fails"
    ]
    failed = [Table("Checks that fail, and what would mend them", ("flight", "check", "value", "suggestion"), advice)]
    return [logs, checks, *(failed if advice else [])]


def _scores(rows: Sequence[FlightRow], label: str, dt: float) -> Table:
    lines = [(cell_name(cell), *_errors(group, label)) for cell, group in cells(rows).items()]
    what = "mean error of steps 1 to 50, summed" if label == SUM else f"RMSE at step {label} ({int(label) * dt:.3g} s)"
    seeds = len({row.seed for row in rows})
    of = f"mean ± std over {seeds} seeds" if seeds > 1 else "one seed"
    return Table(f"{what[0].upper()}{what[1:]}; {of}, test windows of all folds", ("model", *_units()), lines)


def _errors(rows: Sequence[FlightRow], label: str) -> list[str]:
    return [_spread(pooled(rows, label, quantity)) for quantity in QUANTITIES]


def _units() -> list[str]:
    return [f"{name.replace('_', ' ')} [{unit}]" for name, unit in QUANTITIES.items()]


def _spread(values: np.ndarray) -> str:
    if not np.isfinite(values).all():
        return f"∞ ({int((~np.isfinite(values)).sum())} of {len(values)} seeds)"
    text = f"{values.mean():.4g}"
    return text if len(values) == 1 else f"{text} ± {values.std(ddof=1):.2g}"


def _parameter(rows: Sequence[FlightRow], name: str) -> str:
    having = [row for row in rows if name in (row.theta or {})]  # another fold's recipe may not learn it
    if not having:
        return "–"
    values = np.array([_float((row.theta or {})[name]) for row in having])
    text = _number(values.mean()) + (f" ± {values.std(ddof=1):.1g}" if len(values) > 1 else "")
    ends = [(row.theta_interval or {}).get(name) for row in having]
    known = np.array([end for end in ends if end is not None and None not in end], float)
    text += f" [{_number(known[:, 0].mean())}, {_number(known[:, 1].mean())}]" if len(known) else ""
    folds, all_folds = (len({row.fold for row in group}) for group in (having, rows))
    return text if folds == all_folds else f"{text} ({folds} of {all_folds} folds)"


def _float(value: float | None) -> float:
    return math.nan if value is None else value


def _number(value: float | None) -> str:
    return "–" if value is None else f"{value:.3g}"


def _verdict(check: Mapping[str, Any]) -> str:
    return f"{VERDICTS[check['verdict']]} {_value(check)}".strip()


def _value(check: Mapping[str, Any]) -> str:
    value = check["value"]
    known = isinstance(value, float | int) and math.isfinite(value)
    return f"{value:.2g}{' ms' if check['unit'] == 'ms' else ''}" if known else ""
