"""One row per trained model: its fields, its checks, and its forms in JSON and CSV."""

import csv
import io
import math
import operator
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields, replace
from typing import Any

MODELS = ("hybrid", "no_physics", "physics_only")
MODES = ("fine_tuned", "target_only", "source_only")
STATUSES = ("ok", "capped", "diverged")
THETA = ("Ix", "Iy", "k")
NAMES = {name: name.replace("_", "-") for name in MODELS + MODES}  # for people
_NOT_FINITE = "null"  # in CSV, where an empty cell means: this model has no such number


@dataclass(frozen=True)
class Row:
    """The result of one training run. A number that is not finite is None, as it will be in JSON.

    Attributes:
        model: one of MODELS.
        mode: one of MODES.
        n_train: target trajectories trained on; 0 if and only if the mode is source_only.
        seed: fixes initialisation, minibatch order and the trajectories drawn.
        test_mse: L^T_MSE, the test error in the target.
        rho: ρ = (L^S − L^T) / L^S against the source-only model of the same seed (paper, Eq. 9); see `with_rho`.
        val_mse: L_MSE of the best epoch on the validation windows.
        epochs: epochs trained.
        status: one of STATUSES.
        theta: Ix, Iy [kg m²] and k [N/(rad/s)²]; None for a model without physics.

    Raises:
        ValueError: a field out of its range, named.
    """

    model: str
    mode: str
    n_train: int
    seed: int
    test_mse: float | None
    rho: float | None
    val_mse: float | None
    epochs: int
    status: str
    theta: Mapping[str, float | None] | None

    def __post_init__(self):
        for name, choices in (("model", MODELS), ("mode", MODES), ("status", STATUSES)):
            if getattr(self, name) not in choices:
                raise ValueError(f"{name} must be one of {', '.join(choices)}, got {getattr(self, name)!r}")
        for name in ("n_train", "seed", "epochs"):
            object.__setattr__(self, name, _count(name, getattr(self, name)))
        for name in ("test_mse", "rho", "val_mse"):
            object.__setattr__(self, name, _finite_or_none(name, getattr(self, name)))
        if min(self.error, math.inf if self.val_mse is None else self.val_mse) < 0:
            raise ValueError(f"test_mse and val_mse must not be negative, got {self.test_mse} and {self.val_mse}")
        if (self.n_train == 0) != (self.mode == "source_only"):
            raise ValueError(f"n_train must be 0 for source_only and only there, got {self.n_train} for {self.mode}")
        object.__setattr__(self, "theta", _check_theta(self.theta))

    @property
    def error(self) -> float:
        """The test error with which the row counts: infinite if it was not finite."""
        return math.inf if self.test_mse is None else self.test_mse

    @property
    def gain(self) -> float:
        """The ρ with which the row counts. Where it is None: −∞ if the row's own error was not finite, else 1, the
        limit of ρ for a source-only error that grows beyond bounds."""
        if self.rho is not None:
            return self.rho
        return -math.inf if self.test_mse is None else 1.0


def with_rho(rows: Iterable[Row]) -> list[Row]:
    """The rows with ρ = (L^S − L^T) / L^S (paper, Eq. 9); L^S is the source-only error of the same model and seed.

    Raises:
        ValueError: a row without its source-only row, or a source-only error of 0, against which nothing is a gain.
    """
    rows = check_unique(rows)
    source = {(row.model, row.seed): row.error for row in rows if row.mode == "source_only"}
    lacking = [row for row in rows if (row.model, row.seed) not in source]
    if lacking:
        raise ValueError(f"no source_only row of {lacking[0].model}, seed {lacking[0].seed}: ρ is not defined")
    if 0 in source.values():
        raise ValueError("a source_only row has test_mse 0: ρ is not defined")
    return [replace(row, rho=_rho(source[row.model, row.seed], row.error)) for row in rows]


def check_unique(rows: Iterable[Row]) -> list[Row]:
    """The rows as a list.

    Raises:
        ValueError: two rows of the same model, mode, n_train and seed.
    """
    rows = list(rows)
    for key, times in Counter((row.model, row.mode, row.n_train, row.seed) for row in rows).items():
        if times > 1:
            raise ValueError("{} {} with n_train {}, seed {} stands {} times in the rows".format(*key, times))
    return rows


def row_from(record: Any) -> Row:
    """The row of a JSON object.

    Raises:
        ValueError: not an object of exactly the row's fields, or a field out of its range.
    """
    names = {field.name for field in fields(Row)}
    if not isinstance(record, Mapping) or set(record) != names:
        raise ValueError(f"a row must be an object of {', '.join(sorted(names))}")
    return Row(**record)


def to_csv(rows: Iterable[Row]) -> str:
    """The rows as CSV: theta in columns Ix, Iy, k, empty where there is none; a number that is not finite is `null`."""
    text = io.StringIO()
    names = [field.name for field in fields(Row) if field.name != "theta"]
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([*names, *THETA])
    for row in rows:
        theta = [""] * len(THETA) if row.theta is None else [_cell(row.theta[name]) for name in THETA]
        writer.writerow([*(_cell(getattr(row, name)) for name in names), *theta])
    return text.getvalue()


def from_csv(text: str) -> list[Row]:
    """The rows that `to_csv` wrote.

    Raises:
        ValueError: other columns, or a field out of its range.
    """
    rows = []
    for record in csv.DictReader(io.StringIO(text)):
        if None in record or None in record.values():
            raise ValueError("a line of the CSV has too many or too few cells")
        theta = {name: record.pop(name, "") for name in THETA}
        numbers: dict[str, Any] = {name: int(record.pop(name, "")) for name in ("n_train", "seed", "epochs")}
        numbers |= {name: _number(record.pop(name, "")) for name in ("test_mse", "rho", "val_mse")}
        given = any(theta.values())
        numbers["theta"] = {name: _number(cell) for name, cell in theta.items()} if given else None
        rows.append(row_from(record | numbers))
    return rows


def _rho(source: float, adapted: float) -> float:
    return (source - adapted) / source if math.isfinite(source) else math.nan


def _count(name: str, value: Any) -> int:
    try:
        count = -1 if isinstance(value, bool) else operator.index(value)
    except TypeError:
        count = -1
    if count < 0:
        raise ValueError(f"{name} must be an integer of at least 0, got {value!r}")
    return count


def _finite_or_none(name: str, value: Any) -> float | None:
    if value is None:
        return None
    try:
        number = None if isinstance(value, bool | str | bytes) else float(value)
    except (TypeError, ValueError, OverflowError):
        number = None
    if number is None:
        raise ValueError(f"{name} must be a number or null, got {value!r}")
    return number if math.isfinite(number) else None


def _check_theta(theta: Any) -> dict[str, float | None] | None:
    if theta is None:
        return None
    if not isinstance(theta, Mapping) or set(theta) != set(THETA):
        raise ValueError(f"theta must hold exactly {', '.join(THETA)} or be null, got {theta!r}")
    return {name: _finite_or_none(f"theta.{name}", theta[name]) for name in THETA}


def _cell(value: Any) -> str:
    return _NOT_FINITE if value is None else repr(value) if isinstance(value, float) else str(value)


def _number(cell: str) -> float | None:
    return None if cell == _NOT_FINITE else float(cell)
