"""One row per closed-loop flight: the agent, the reference, and the tracking performance."""

import csv
import io
import math
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, fields

from experiments.paper import rows as shifts

UNCHANGED = "source"  # the domain of the vehicle before the change
DOMAINS = (UNCHANGED, *shifts.DOMAINS)
NAMES = {UNCHANGED: "unchanged vehicle"} | {domain: shifts.NAMES[domain] for domain in shifts.DOMAINS}
REFERENCES = {  # id → name in tables and figures
    "hover": "hover",
    "figure_eight": "figure-8, 3.5 m/s",
    "fast_figure_eight": "figure-8, 6 m/s",
    "step": "step",
    "low_pass": "low pass",
    "upset": "hover from 6 rad/s",
}
LEARNED = {
    "physics": "physics",
    "hybrid": "hybrid",
    "no_physics": "no-physics",
    "invariant": "invariant hybrid",
    "least_squares": "invariant, least squares",
}
SOURCES = {"hybrid": "hybrid", "invariant": "invariant", "least_squares": "invariant"}  # adapted → source model
KNOWN = {"nominal": "nominal physics", "oracle": "true vehicle, mean wind"}
MODELS = (*KNOWN, *LEARNED)
NUMBERS = ("position_rmse", "yaw_rmse", "largest_error", "saturation", "promised", "realised", "excess")


@dataclass(frozen=True, order=True)
class Agent:
    """A controller with its prediction model.

    Attributes:
        model: one of MODELS. "invariant" has a translation- and yaw-invariant residual; "least_squares" is its source
            model with θ_p and a constant disturbance refitted.
        n_train: target trajectories for adaptation; 0 for a source model.
        observer: with a disturbance observer.
        variant: of the model or the controller, in an ablation; else empty.
    """

    model: str
    n_train: int = 0
    observer: bool = False
    variant: str = ""

    @property
    def name(self) -> str:
        """In tables and figures."""
        size = f"N = {self.n_train}" if self.n_train else "source"
        name = KNOWN[self.model] if self.model in KNOWN else f"{LEARNED[self.model]}, {size}"
        return (f"{self.variant}, {name}" if self.variant else name) + (" + observer" if self.observer else "")


@dataclass(frozen=True)
class FlightRow:
    """The result of one flight. A number that is not finite is None, as in JSON.

    Attributes:
        domain: one of DOMAINS.
        model, n_train, observer, variant: see `Agent`.
        reference: one of REFERENCES.
        distance: of the flight from home [m].
        seed: of the model's training; 0 for a model that was not trained.
        position_rmse: after the initial state [m].
        yaw_rmse: [rad].
        largest_error: of position [m].
        crashed, saturation: see `hybrid_jax.control.Performance`.
        promised, realised: predicted and actual open-loop cost, mean over the plans of some calls.
        excess: see `hybrid_jax.control.relative_cost_error`.

    Raises:
        ValueError: an unknown domain, model or reference.
    """

    domain: str
    model: str
    n_train: int
    observer: bool
    variant: str
    reference: str
    distance: float
    seed: int
    position_rmse: float | None
    yaw_rmse: float | None
    largest_error: float | None
    crashed: bool
    saturation: float | None
    promised: float | None
    realised: float | None
    excess: float | None

    def __post_init__(self):
        for name, choices in (("domain", DOMAINS), ("model", MODELS), ("reference", tuple(REFERENCES))):
            if getattr(self, name) not in choices:
                raise ValueError(f"{name} must be one of {', '.join(choices)}, got {getattr(self, name)!r}")
        for name in NUMBERS:
            value = getattr(self, name)
            finite = None if value is None or not math.isfinite(value) else float(value)
            object.__setattr__(self, name, finite)

    @property
    def agent(self) -> Agent:
        """The agent that flew."""
        return Agent(self.model, self.n_train, self.observer, self.variant)

    @property
    def error(self) -> float:
        """Position RMSE [m]; infinite for a crash."""
        return self.number("position_rmse")

    def number(self, name: str) -> float:
        """One of NUMBERS; infinite for a crash or where it was not finite."""
        value = getattr(self, name)
        return math.inf if self.crashed or value is None else value


Cell = tuple[str, str, float]  # domain, reference, distance
Group = dict[Agent, list[FlightRow]]
Cells = dict[Cell, Group]


def cells(rows: Iterable[FlightRow]) -> Cells:
    """Rows by (domain, reference, distance) and agent, in the order of the rows, sorted by seed.

    Raises:
        ValueError: two rows of the same flight.
    """
    found: Cells = {}
    for row in rows:
        group = found.setdefault((row.domain, row.reference, row.distance), {}).setdefault(row.agent, [])
        if any(other.seed == row.seed for other in group):
            raise ValueError(f"{row.domain}, {row.reference}, {row.agent.name}: two rows of seed {row.seed}")
        group.append(row)
    for agents in found.values():
        for group in agents.values():
            group.sort(key=lambda row: row.seed)
    return found


def paired(group: Sequence[FlightRow], like: Sequence[FlightRow]) -> list[float]:
    """Errors [m] of a group for the seeds of another; a model that was not trained has the same error for each."""
    by_seed = {row.seed: row.error for row in group}
    return [by_seed[0] if len(group) == 1 else by_seed[row.seed] for row in like]


def to_csv(rows: Sequence[FlightRow]) -> str:
    """The rows as CSV, with `null` for a number that was not finite."""
    text = io.StringIO()
    writer = csv.DictWriter(text, [field.name for field in fields(FlightRow)], lineterminator="\n")
    writer.writeheader()
    for row in rows:
        writer.writerow({name: "null" if value is None else value for name, value in asdict(row).items()})
    return text.getvalue()
