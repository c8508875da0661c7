"""Tables of logs: what was done to each, every check, and what would mend those that failed."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

from experiments.reporting.tables import Table
from hybrid_jax.flights.checks.consistency import FAILS, WARNS

VERDICTS = {"ok": "ok", "warns": "warns", "fails": "FAILS", "cannot tell": "?"}
CHECKED = "Checks: of each log as recorded, then of the cleaned flight (? cannot tell; the value is beside the verdict)"
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


def log_tables(records: Sequence[Mapping[str, Any]]) -> list[Table]:
    """Make tables of the logs: length, gaps, changes, every check, and what would repair the failed ones."""
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
    tables = [Table("Logs", header, lines, folded=True), Table(CHECKED, ("flight", *names), verdicts, folded=True)]
    advice = Table("Checks that failed or warn, and what to do", ("flight", "check", "value", "suggestion"), failed)
    return [*([advice] if failed else []), *tables]


def failed_checks(records: Sequence[Mapping[str, Any]]) -> list[tuple[str, Mapping[str, Any]]]:
    """The checks that failed or warn, each with its flight."""
    named = [(f"{record['folder']}/{record['flight']}", check) for record in records for check in record["checks"]]
    return [(flight, check) for flight, check in named if check["verdict"] in (FAILS, WARNS)]


def _value(check: Mapping[str, Any]) -> str:
    return f"{check['value']:.2g}{' ms' * (check['unit'] == 'ms')}" if math.isfinite(check["value"]) else ""
