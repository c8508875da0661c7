"""The verb `hybrid-jax plan`: design the most informative ten seconds of flight for a model."""

import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import equinox as eqx
import jax
import matplotlib as mpl
import numpy as np
import tyro
from matplotlib.figure import Figure

from hybrid_jax.cli import page
from hybrid_jax.cli.command import step
from hybrid_jax.cli.help import RARE
from hybrid_jax.dynamics import DisturbanceModel
from hybrid_jax.dynamics.disturbance import with_disturbance
from hybrid_jax.dynamics.rigid_body import hold_corrections
from hybrid_jax.estimation.uncertainty import named_parameters
from hybrid_jax.identification.learning import without_past
from hybrid_jax.io.files import write_atomic
from hybrid_jax.io.models import load
from hybrid_jax.planning import Excitation, FlightBounds, excitation
from hybrid_jax.vehicle import POSITION, VELOCITY

__all__ = ["Options", "run"]
WINDOW, HALF, WELL = 10, 1.96, 0.1  # intervals; standard errors of half an interval; share of a value
MAIN = 5  # intervals that are not folded
MEANS = "You should get these intervals if the model is right, for an unknown constant force and torque."
CHANGING = "The errors that the model predicts from its past are treated as a force and torque that change as much."
HEADER = "t,px,py,pz,yaw,vx,vy,vz"
BOX = FlightBounds()


@dataclass(frozen=True)
class Options:
    """Plan the most informative flight for the parameters of a model, inside a box.

    It begins and ends in hover at the centre of the box. A constant force and torque are treated as unknown, too.
    """

    model: Annotated[Path, tyro.conf.Positional]
    """Model that `hybrid-jax fit` or `adapt` wrote."""
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """CSV file for the set points. Its columns are time [s], position [m], yaw [rad] and velocity [m/s]."""
    learn: tuple[str, ...] = ()
    """Parameters to identify. By default all of the model's physics."""
    seconds: float = 10.0
    """Length of the flight [s]."""
    low: tuple[float, float, float] = BOX.low
    """Lower corner of the box [m]. Give x, y and z, which points up."""
    high: tuple[float, float, float] = BOX.high
    """The opposite corner [m]."""
    speed: float = BOX.speed
    """Highest speed [m/s]."""
    tilt: float = BOX.tilt
    """Largest tilt [rad]."""
    yaw: float = BOX.yaw
    """Largest absolute heading [rad]."""
    bandwidth: float = 2.0
    """Highest frequency of the flight [Hz]. Frequencies that your controller cannot track add little information."""
    out: Path = Path("runs/plan")
    """Folder for report.html and report.json."""
    rotor_speed: Annotated[tuple[float, float], RARE] = BOX.rotor_speed
    """Lowest and highest rotor speed, as shares of the vehicle's highest speed."""
    noise: Annotated[tuple[float, ...], RARE, tyro.conf.arg(name="noise-std")] = ()
    """Standard deviation of the noise of each of the 13 states, by default typical of motion capture."""
    starts: Annotated[int, RARE] = 4
    """Number of random initial flights of the search."""
    steps: Annotated[int, RARE, tyro.conf.arg(name="iterations")] = 200
    """Iterations of the search."""
    seed: Annotated[int, RARE] = 0
    """Random seed of the initial flights."""


def run(options: Options) -> int:
    model = load(options.model)
    dt, field = model.about.get("dt", 0.01), with_disturbance(hold_corrections(without_past(model.field)))
    planned = eqx.tree_at(without_past, model.field, field)
    box = FlightBounds(options.low, options.high, options.speed, options.tilt, options.yaw, options.rotor_speed)
    search = {name: getattr(options, name) for name in ("seconds", "bandwidth", "starts", "steps")}
    search |= {"noise": options.noise or None, "window": WINDOW * dt, "dt": dt}
    with step("searching for the flight, a minute or two"), warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        found = excitation(planned, options.learn or None, box, jax.random.key(options.seed), **search)
    place, yaw = jax.vmap(found.reference)(found.t)
    points = np.column_stack([found.t, place, yaw, found.states[:, VELOCITY]])
    lines = [HEADER, *(",".join(f"{number:.5g}" for number in row) for row in points)]
    write_atomic(options.output, ("\n".join(lines) + "\n").encode())
    values = {name: float(value) for name, value in named_parameters(field).items()}
    meaning = [CHANGING] * isinstance(model.field, DisturbanceModel)
    meaning += [str(each.message).removeprefix("excitation: ") for each in caught]
    record = {"standard_errors": found.standard_errors, "margins": found.margins, "set_points": options.output}
    page.write(options.out, "plan", _page(options, found, points, values, field.parameter_units, meaning), record)
    return 0


def _page(options: Options, found: Excitation, points: np.ndarray, values, units, meaning) -> page.Page:
    halves = {name: HALF * error for name, error in found.standard_errors.items()}
    shares = {name: half / abs(values[name]) if values[name] else np.inf for name, half in halves.items()}
    named = {name: f"{values[name]:.4g} {units.get(name.partition('[')[0], '')}" for name in halves}
    share = {name: f"{each:.1%}" if each < 1 else "more than 100%" for name, each in shares.items()}
    rows = [(name, named[name], f"± {half:.2g}", share[name]) for name, half in halves.items()]
    header = ("parameter", "value", "half-width", "of the value")
    worst, within = max(found.parameters, key=lambda name: shares[name]), sum(each < WELL for each in shares.values())
    left = [(name, f"{margin:.0%}") for name, margin in found.margins.items()]
    least = f"{worst} is the least certain: {named[worst]} ± {halves[worst]:.2g}"
    return page.Page(
        f"Which {options.seconds:g} s of flight identify the parameters of {options.model.name} best?",
        f"{options.output} determines {within} of {len(rows)} parameters to ± {WELL:.0%} or better; {least}.",
        page.Table("Expected 95 % intervals", header, rows[:MAIN]),
        [("The flight: from above, and over time", _figure(found, points))],
        [MEANS, *meaning],
        [
            "Fly these set points, first at a height where an error costs nothing, and log the flight.",
            f"Then: hybrid-jax adapt {options.model} LOGS -o adapted.npz.",
        ],
        [
            *[page.Table("All intervals", header, rows)] * (len(rows) > MAIN),
            page.Table("What is left of limits", ("limit", "left"), left),
        ],
    )


@mpl.rc_context(page.STYLE)
def _figure(found: Excitation, points: np.ndarray) -> Figure:
    figure = Figure(figsize=(6.0, 3.2), layout="constrained")
    above, time = figure.subplots(1, 2)
    above.plot(*found.states[:, POSITION].T[:2])
    above.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
    speed = np.linalg.norm(found.states[:, VELOCITY], axis=1)
    for name, values in (("height [m]", points[:, 3]), ("yaw [rad]", points[:, 4]), ("speed [m/s]", speed)):
        time.plot(found.t, values, label=name)
    time.set_xlabel("time [s]")
    figure.legend(loc="outside lower center", ncols=3)
    return figure
