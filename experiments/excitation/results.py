"""Claims, tables and figures of the designed flights."""

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import jax.numpy as jnp
import matplotlib as mpl
import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure

from experiments.reporting.claims import Claim, Part, all_of
from experiments.reporting.names import HYBRID
from experiments.reporting.plots import COLOURS, STYLE, Line, dots, subplots, titled
from experiments.reporting.results import Results
from experiments.reporting.statistics import Estimate, mean_interval
from experiments.reporting.tables import Table, cross_table, over_seeds, tabulate
from hybrid_jax.planning import Excitation, FlightBounds
from hybrid_jax.rotation import heading
from hybrid_jax.vehicle import POSITION, QUATERNION, VELOCITY

RANDOM, DESIGNED = "random", "designed"
FLIGHTS = ("hover", "figure-8", RANDOM, DESIGNED)
GOAL = 0.5  # the worst parameter's interval after the designed flight, over that after random flight, at most
WIDEST = 1000.0  # %: wider intervals say nothing
Flown = tuple[Float[np.ndarray, "n+1 13"], Float[np.ndarray, "n rotors"]]  # true states, rotor speeds


class DesignEvidence(NamedTuple):
    rows: Results
    margins: Mapping[str, tuple[float, float]]  # of each limit: how far the flown flight went, and the limit


def margins(bounds: FlightBounds, states: Float[np.ndarray, "n 13"]) -> dict[str, tuple[float, float]]:
    """Return the vehicle's distance towards each limit, and the limit, from the middle of the box."""
    place = states[:, POSITION] - (np.array(bounds.low) + np.array(bounds.high)) / 2
    half = (np.array(bounds.high) - np.array(bounds.low)) / 2
    upright = 1 - 2 * (states[:, QUATERNION.start + 1] ** 2 + states[:, QUATERNION.start + 2] ** 2)
    found = {f"{axis} [m]": (np.abs(place[:, i]).max(), half[i]) for i, axis in enumerate("xyz")}
    found["speed [m/s]"] = np.linalg.norm(states[:, VELOCITY], axis=1).max(), bounds.speed
    found["tilt [rad]"] = np.arccos(np.clip(upright, -1, 1)).max(), bounds.tilt
    found["yaw [rad]"] = np.abs(heading(jnp.asarray(states[:, QUATERNION]))).max(), bounds.yaw
    return {name: (float(used), float(limit)) for name, (used, limit) in found.items()}


def worst(rows: Results, column: str) -> dict[int, float]:
    return {seed: float(own.numbers(column).max()) for seed, own in rows.group("seed").items()}


def ratio(rows: Results, name: str, column: str = "half_width") -> Estimate:
    """Geometric mean over seeds of the designed flight's worst interval over another flight's."""
    ours, theirs = (worst(rows.where(flight=flight), column) for flight in (DESIGNED, name))
    with np.errstate(divide="ignore"):  # nothing beside an infinite interval
        logs = [float(np.log(ours[seed] / theirs[seed])) for seed in ours]
    return Estimate(*map(math.exp, mean_interval(logs, list(ours))))


def _halves(evidence: DesignEvidence) -> Part:
    found = ratio(evidence.rows, RANDOM)
    return found.below(GOAL), f"{found.text('.2f')} of that after random flight"


def _stays_inside(evidence: DesignEvidence) -> Part:
    found = evidence.margins.items()
    return all_of((used <= limit, f"{name} {used:.2f} of {limit:.2g}") for name, (used, limit) in found)


CLAIMS = (
    Claim(
        "X1",
        "The widest interval of a parameter after the designed flight is at most half of that after random flight of "
        "the same length (interval over seeds).",
        _halves,
    ),
    Claim("X2", "The vehicle, flown by the controller, stays inside the limits of the design.", _stays_inside),
)


def conclusion(rows: Results) -> list[str]:
    def times(name: str, column: str = "half_width") -> str:
        share = ratio(rows, name, column).value
        return f"{1 / share:.2g} times" if share > 1 / WIDEST else f"more than {WIDEST:g} times"

    own = rows.where(flight=DESIGNED)
    wide = np.mean(list(worst(own, "half_width").values()))
    others = ", ".join(f"{times(name)} narrower than after {name}" for name in FLIGHTS[::-1] if name != DESIGNED)
    return [
        f"After the designed flight the widest interval is ±{wide:.2g} %, {others}.",
        f"If the model were exact, it would be {times(RANDOM, 'predicted')} narrower than after random; the rest "
        "probably comes with drag and ground effect, which the model lacks.",
        f"{np.mean(own['inside']):.0%} of the designed flight's 95 % intervals contain the true value.",
    ]


def tables(rows: Results) -> list[Table]:
    def mean(column: str, form: str = ".3g"):
        def text(own: Results) -> str:
            found = float(own.numbers(column).mean())
            return f"{found:{form}}" if abs(found) <= WIDEST else f"> {WIDEST:g}"

        return text

    columns = {name: {"parameter": name} for name in rows.unique("parameter")}
    title = f"Half-width of the 95 % interval [%], {over_seeds(rows)}"
    widths = cross_table(title, rows.group("flight"), columns, mean("half_width"), "flight")
    more = {
        "half-width [%]": mean("half_width"),
        "predicted [%]": mean("predicted"),
        "error, RMS [%]": lambda own: f"{np.sqrt(np.mean(np.square(own.numbers('error')))):.3g}",
        "bias [%]": mean("error", "+.2f"),
        "contain the true value [%]": lambda own: f"{100 * np.mean(own['inside']):.0f}",
    }
    head = ("flight", "parameter")
    return [widths, tabulate("Intervals, their prediction and errors", rows.group(*head), more, head)]


def margin_table(planned: Mapping[str, float], flown: Mapping[str, tuple[float, float]]) -> Table:
    shares = {name: f"{left:.0%}" for name, left in planned.items()}
    lines = [
        (name, f"{limit:.2g}", shares.get(name.split(" ")[0], ""), f"{used:.2f}")
        for name, (used, limit) in flown.items()
    ]
    return Table("Limits", ("limit", "value", "left by the plan", "used in flight"), lines)


def described(design: Excitation) -> dict[str, Any]:
    return {
        "parameters": design.parameters,
        "information": design.information.tolist(),
        "standard_errors": design.standard_errors,
        "margins": design.margins,
        "log_det": design.log_det,
    }


def draw(rows: Results) -> dict[str, tuple[Figure, str]]:
    caption = (
        f"Half-width of the 95 % intervals of each flight; a dot is a seed, a bar the median, ▷ above {WIDEST:g} %"
    )
    return {"intervals": (interval_figure(rows), caption)}


@mpl.rc_context(STYLE)
def interval_figure(rows: Results) -> Figure:
    """Draw a panel per parameter, a line per flight; intervals wider than `WIDEST` are triangles."""
    names = rows.unique("parameter")
    figure, panels = subplots(2.3, 1, len(names), sharex=True, sharey=True)
    for axes, name in zip(panels[0], names, strict=True):
        found = {flight: rows.where(parameter=name, flight=flight).numbers("half_width") for flight in FLIGHTS}
        tints = {flight: COLOURS[HYBRID] if flight == DESIGNED else "0.35" for flight in FLIGHTS}
        dots(axes, [Line(flight, own, tints[flight]) for flight, own in found.items()], WIDEST)
        axes.set(title=name)
    figure.supxlabel("half-width [% of the value] (log scale; lower is better)", fontsize="medium")
    return titled(figure, f"How wide is the 95 % interval? (dot: a seed, bar: median, ▷: above {WIDEST:g} %)")
