"""The tags of closed-loop results, their labels, and the agents that flew."""

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass, fields

from experiments.reporting.names import EXTERNAL_FORCE, LABELS, PARAMETER_SHIFT
from experiments.reporting.results import Results, Row

UNCHANGED = "source"  # the domain of the vehicle before the change
DOMAINS = {UNCHANGED: "unchanged vehicle"} | {name: LABELS[name] for name in (PARAMETER_SHIFT, EXTERNAL_FORCE)}
REFERENCES = {
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


@dataclass(frozen=True, order=True)
class Agent:
    """A controller with its prediction model."""

    model: str  # a key of KNOWN or LEARNED
    n_train: int = 0  # target trajectories for adaptation; 0 for a source model
    observer: bool = False  # with a disturbance observer
    variant: str = ""  # of the model or the controller, in an ablation

    @property
    def name(self) -> str:
        """Label in tables and figures."""
        size = f"N = {self.n_train}" if self.n_train else "source"
        name = KNOWN[self.model] if self.model in KNOWN else f"{LEARNED[self.model]}, {size}"
        return (f"{self.variant}, {name}" if self.variant else name) + (" + observer" if self.observer else "")


ORACLE = Agent("oracle")
TAGS = ("domain", *(field.name for field in fields(Agent)), "reference", "distance", "seed")
# Tracking performance in m, rad, m, whether it crashed, the share of saturated inputs; the mean predicted and actual
# open-loop cost of plans, and their relative error. The last three keep their names of earlier reports.
NUMBERS = ("position_rmse", "yaw_rmse", "largest_error", "crashed", "saturation", "promised", "realised", "excess")


def uncrashed(column: str, factor: float = 1.0) -> Callable[[Row], float]:
    """One of NUMBERS times a factor; infinite for a crash or where it was not finite."""
    return lambda row: math.inf if row["crashed"] or row[column] is None else factor * row[column]


ERROR = uncrashed("position_rmse")


def by_agent(rows: Results) -> dict[Agent, Results]:
    """The rows of each agent, in order of appearance."""
    return {Agent(*key): group for key, group in rows.group(*asdict(ORACLE)).items()}


def away(distance: float) -> str:
    """What a name of a place has at its end."""
    return f", {distance:g} m away" if distance else ""


def centimetres(rows: Results) -> float:
    """Mean position RMSE [cm] over seeds; infinite if one crashed."""
    return 100 * rows.spread(ERROR).mean
