"""One row per closed-loop flight: who flew, where, how well, and what was promised."""

import csv
import io
import math
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, fields

from experiments.paper import rows as shifts

UNCHANGED = "source"  # the domain of the vehicle as it was before the change
DOMAINS = (UNCHANGED, *shifts.DOMAINS)
NAMES = {UNCHANGED: "unchanged vehicle"} | {domain: shifts.NAMES[domain] for domain in shifts.DOMAINS}  # for people
REFERENCES = {  # name → for people
    "hover": "hover",
    "figure_eight": "figure-8, 3.5 m/s",
    "fast_figure_eight": "figure-8, 6 m/s",
    "step": "step",
    "low_pass": "low pass",
    "upset": "upset, 6 rad/s",
}
LEARNED = {
    "physics": "physics",
    "hybrid": "hybrid",
    "no_physics": "no-physics",
    "safe": "safe hybrid",
    "nine": "safe, nine numbers",
}
SOURCES = {"hybrid": "hybrid", "safe": "safe", "nine": "safe"}  # hybrids → what each was before it was adapted
KNOWN = {"nominal": "nominal physics", "oracle": "true vehicle, mean wind"}
MODELS = (*KNOWN, *LEARNED)


@dataclass(frozen=True, order=True)
class Flyer:
    """What the controller believes in.

    Attributes:
        model: one of MODELS; "safe" is a hybrid whose network reads and writes less, "nine" the same of which θ_p and
            a constant disturbance alone are adapted.
        n_train: target trajectories that it was adapted to; 0 for none.
        observer: whether a disturbance observer corrects it in flight.
        variant: what was changed of the model or the controller, in an ablation; empty for nothing.
    """

    model: str
    n_train: int = 0
    observer: bool = False
    variant: str = ""

    @property
    def name(self) -> str:
        """For people."""
        if self.model in KNOWN:
            name = KNOWN[self.model]
        else:
            name = f"{LEARNED[self.model]}, {f'N = {self.n_train}' if self.n_train else 'source'}"
        return (f"{self.variant}, {name}" if self.variant else name) + (" + observer" if self.observer else "")


@dataclass(frozen=True)
class FlightRow:
    """The outcome of one flight. A number that is not finite is None, as it will be in JSON.

    Attributes:
        domain: what was flown, one of DOMAINS.
        model, n_train, observer, variant: see `Flyer`.
        reference: one of REFERENCES.
        distance: of the flight from home [m].
        seed: of the model's training; 0 for a model that was not trained.
        position_rmse: [m], over the flight after its start.
        yaw_rmse: [rad].
        largest_error: of position [m].
        crashed: see `hybrid_jax.control.Performance`.
        saturation: share of the rotor speeds at a limit.
        promised, realised: mean cost of the plans of some calls, by the model and rolled open loop in the truth.
        excess: see `hybrid_jax.control.promises.excess`.

    Raises:
        ValueError: a domain, a model or a reference that is none of these.
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
        named = (("domain", DOMAINS), ("model", MODELS), ("reference", tuple(REFERENCES)))
        for name, choices in named:
            if getattr(self, name) not in choices:
                raise ValueError(f"{name} must be one of {', '.join(choices)}, got {getattr(self, name)!r}")
        for name in NUMBERS:
            value = getattr(self, name)
            finite = None if value is None or not math.isfinite(value) else float(value)
            object.__setattr__(self, name, finite)

    @property
    def flyer(self) -> Flyer:
        """Who flew."""
        return Flyer(self.model, self.n_train, self.observer, self.variant)

    @property
    def error(self) -> float:
        """The position RMSE [m] with which the flight counts: infinite if it crashed."""
        return math.inf if self.crashed or self.position_rmse is None else self.position_rmse

    def number(self, name: str) -> float:
        """One of NUMBERS as it counts: infinite where it was not finite, and of a crash."""
        value = getattr(self, name)
        return math.inf if self.crashed or value is None else value


NUMBERS = ("position_rmse", "yaw_rmse", "largest_error", "saturation", "promised", "realised", "excess")
Cell = tuple[str, str, float]  # domain, reference, distance
Cells = dict[Cell, dict[Flyer, list[FlightRow]]]


def cells(rows: Iterable[FlightRow]) -> Cells:
    """The rows of each domain, reference and distance by who flew, in the order in which they come, by seed.

    Raises:
        ValueError: a flight stands twice.
    """
    found: Cells = {}
    for row in rows:
        group = found.setdefault((row.domain, row.reference, row.distance), {}).setdefault(row.flyer, [])
        if any(other.seed == row.seed for other in group):
            raise ValueError(f"{row.domain}, {row.reference}, {row.flyer.name}: seed {row.seed} stands twice")
        group.append(row)
    for flyers in found.values():
        for group in flyers.values():
            group.sort(key=lambda row: row.seed)
    return found


def paired(group: Sequence[FlightRow], like: Sequence[FlightRow]) -> list[float]:
    """The errors [m] of a group for the seeds of another one: a model that was not trained is the same for all."""
    by_seed = {row.seed: row.error for row in group}
    return [by_seed[0] if len(group) == 1 else by_seed[row.seed] for row in like]


def to_csv(rows: Sequence[FlightRow]) -> str:
    """The rows as CSV; a number that was not finite is `null`."""
    text = io.StringIO()
    writer = csv.DictWriter(text, [field.name for field in fields(FlightRow)], lineterminator="\n")
    writer.writeheader()
    for row in rows:
        writer.writerow({name: "null" if value is None else value for name, value in asdict(row).items()})
    return text.getvalue()
