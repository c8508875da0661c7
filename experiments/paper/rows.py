"""One row per trained model: its fields, its checks, and its forms in JSON and CSV."""

import csv
import io
import math
import operator
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import MISSING, dataclass, fields, replace
from typing import Any

DOMAIN_OF = {"param_shift": "parameter_shift", "external_force": "external_force"}  # of the experiments on one target
DOMAINS = tuple(DOMAIN_OF.values())
RIVALS = (
    *("expert_augmentation", "theta_p_only", "theta_d_only", "last_layer", "least_squares", "constant_disturbance"),
    "linear_residual",
)
MODELS = ("hybrid", "no_physics", "physics_only", *RIVALS)
# A rival starts from the source's hybrid, whose error is the L^S of its ρ; the other models are their own.
SOURCE_OF: dict[str, str] = dict.fromkeys(RIVALS, "hybrid")
MODES = ("fine_tuned", "target_only", "source_only")
STATUSES = ("ok", "capped", "diverged")
THETA = ("Ix", "Iy", "k")
NAMES = {name: name.replace("_", "-") for name in MODELS + MODES} | {  # for people
    "parameter_shift": "parameter shift",
    "external_force": "external force",
    "expert_augmentation": "Expert Augmentation",
    "theta_p_only": "θ_p only",
    "theta_d_only": "θ_d only",
    "last_layer": "last layer (ridge)",
    "least_squares": "least squares on θ_p",
    "constant_disturbance": "least squares on θ_p + disturbance",
    "linear_residual": "source + linear residual",
}
_ENDS = {name: (f"{name}_low", f"{name}_high") for name in THETA}  # columns of an interval in CSV
_NOT_FINITE = "null"  # in CSV, where an empty cell means: this model has no such number


@dataclass(frozen=True)
class Row:
    """The result of one training run. A number that is not finite is None, as it will be in JSON.

    Attributes:
        domain: the target, one of DOMAINS.
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
        theta_interval: [low, high] of the 95 % interval of each, None for one that is not finite; None where the
            method gives no intervals.

    Raises:
        ValueError: a field out of its range, named.
    """

    domain: str
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
    theta_interval: Mapping[str, Sequence[float | None] | None] | None = None

    def __post_init__(self):
        named = (("domain", DOMAINS), ("model", MODELS), ("mode", MODES), ("status", STATUSES))
        for name, choices in named:
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
        object.__setattr__(self, "theta_interval", _check_intervals(self.theta_interval, self.theta))

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
    """The rows with ρ = (L^S − L^T) / L^S (paper, Eq. 9).

    L^S is the source-only error of the same domain, seed and model; for a rival, that of the hybrid (SOURCE_OF).

    Raises:
        ValueError: a row without its source-only row, or a source-only error of 0, against which nothing is a gain.
    """
    rows = check_unique(rows)
    found = {(row.domain, row.model, row.seed): row.error for row in rows if row.mode == "source_only"}
    keys = [(row.domain, SOURCE_OF.get(row.model, row.model), row.seed) for row in rows]
    for key in keys:
        if found.get(key, 0) == 0:
            lack = "a source_only row has test_mse 0:" if key in found else "no source_only row of"
            raise ValueError(f"{lack} {key[1]}, seed {key[2]}, in {key[0]}: ρ is not defined")
    return [replace(row, rho=_rho(found[key], row.error)) for row, key in zip(rows, keys, strict=True)]


def check_unique(rows: Iterable[Row]) -> list[Row]:
    """The rows as a list.

    Raises:
        ValueError: two rows of the same domain, model, mode, n_train and seed.
    """
    rows = list(rows)
    keys = Counter((row.domain, row.model, row.mode, row.n_train, row.seed) for row in rows)
    for key, times in keys.items():
        if times > 1:
            raise ValueError("{}: {} {} with n_train {}, seed {} stands {} times in the rows".format(*key, times))
    return rows


def row_from(record: Any) -> Row:
    """The row of a JSON object; a field that has a default may be missing.

    Raises:
        ValueError: not an object of exactly the row's fields, or a field out of its range.
    """
    names = {field.name for field in fields(Row)}
    needed = {field.name for field in fields(Row) if field.default is MISSING}
    if not isinstance(record, Mapping) or not needed <= set(record) <= names:
        raise ValueError(f"a row must be an object of {', '.join(sorted(names))}")
    return Row(**record)


def to_csv(rows: Iterable[Row]) -> str:
    """The rows as CSV: theta in columns Ix, Iy, k, its intervals in Ix_low, Ix_high, …, empty where there are none; a
    number that is not finite is `null`."""
    text = io.StringIO()
    names = [field.name for field in fields(Row) if field.name not in ("theta", "theta_interval")]
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([*names, *THETA, *(end for ends in _ENDS.values() for end in ends)])
    for row in rows:
        theta = [""] * len(THETA) if row.theta is None else [_cell(row.theta[name]) for name in THETA]
        intervals = {} if row.theta_interval is None else row.theta_interval
        ends = [_cell(end) for name in intervals for end in intervals[name] or (None, None)] or [""] * 2 * len(THETA)
        writer.writerow([*(_cell(getattr(row, name)) for name in names), *theta, *ends])
    return text.getvalue()


def from_csv(text: str) -> list[Row]:
    """The rows that `to_csv` wrote; columns of intervals may be missing.

    Raises:
        ValueError: other columns, or a field out of its range.
    """
    try:
        records = list(csv.DictReader(io.StringIO(text)))
    except csv.Error as error:
        raise ValueError(f"not CSV: {error}") from error
    rows = []
    for record in records:
        if None in record or None in record.values():
            raise ValueError("a line of the CSV has too many or too few cells")
        theta = {name: record.pop(name, "") for name in THETA}
        ends = {name: [record.pop(end, "") for end in _ENDS[name]] for name in THETA}
        numbers: dict[str, Any] = {name: int(record.pop(name, "")) for name in ("n_train", "seed", "epochs")}
        numbers |= {name: _number(record.pop(name, "")) for name in ("test_mse", "rho", "val_mse")}
        numbers["theta"] = _given(theta, theta.values(), _number)
        numbers["theta_interval"] = _given(
            ends, (cell for cells in ends.values() for cell in cells), lambda cells: [_number(cell) for cell in cells]
        )
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


def _check_intervals(
    intervals: Any, theta: Mapping[str, float | None] | None
) -> dict[str, tuple[float, float] | None] | None:
    if intervals is None:
        return None
    if theta is None or not isinstance(intervals, Mapping) or set(intervals) != set(THETA):
        words = f"theta_interval must hold exactly {', '.join(THETA)} or be null, and null where theta is"
        raise ValueError(f"{words}, got {intervals!r}")
    return {name: _check_interval(f"theta_interval.{name}", intervals[name]) for name in THETA}


def _check_interval(name: str, interval: Any) -> tuple[float, float] | None:
    """None for an interval with an end that is not finite: it bounds nothing there."""
    if interval is None:
        return None
    try:
        low, high = interval
    except (TypeError, ValueError):
        raise ValueError(f"{name} must be [low, high] or null, got {interval!r}") from None
    low, high = _finite_or_none(name, low), _finite_or_none(name, high)
    if low is None or high is None:
        return None
    if low > high:
        raise ValueError(f"{name} must have low <= high, got {interval!r}")
    return low, high


def _cell(value: Any) -> str:
    return _NOT_FINITE if value is None else repr(value) if isinstance(value, float) else str(value)


def _number(cell: str) -> float | None:
    return None if cell == _NOT_FINITE else float(cell)


def _given(found: Mapping[str, Any], cells: Iterable[str], read: Callable[[Any], Any]) -> dict[str, Any] | None:
    """What stands in columns that are all empty where a row has none of it."""
    return {name: read(value) for name, value in found.items()} if any(cells) else None
