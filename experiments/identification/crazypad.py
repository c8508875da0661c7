"""Which rotor is damaged, and by how much: python -m experiments.identification.crazypad --help"""

import re
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import jax.numpy as jnp
import numpy as np
import tyro
from jaxtyping import Float
from rich.console import Console

from experiments.identification.record import rmse
from experiments.reporting.tables import Table, print_table
from experiments.runner import command
from hybrid_jax import runtime
from hybrid_jax.dynamics.actuators import Actuator, actuated, rotor_speeds
from hybrid_jax.dynamics.rigid_body import corrected, rigid_body
from hybrid_jax.flights import Recording, read_recording
from hybrid_jax.flights.checks.airborne import airborne, within
from hybrid_jax.identification import Layout, identify
from hybrid_jax.identification.log_checks import inputs_of
from hybrid_jax.vehicle import Vehicle

WHOLE, SECONDS = 47.0, 3.0  # mm of a propeller; s that are learned from
MEASURED = ("attitude", "specific_force")
VEHICLE = Vehicle(
    mass=0.036,
    inertia=(1.7e-5, 1.7e-5, 2.9e-5),
    thrust_coefficient=2e-8,
    torque_coefficient=9e-11,
    rotor_positions=((0.0325, -0.0325), (-0.0325, -0.0325), (-0.0325, 0.0325), (0.0325, 0.0325)),
    spin=(-1.0, 1.0, -1.0, 1.0),
    max_rotor_speed=3000.0,
    name="crazyflie",
)
# The firmware's own thrust [N] of a rotor at 3.5 V, as a polynomial in the PWM's share: grams of four by the voltage.
FULL = 3.5
_GRAMS = np.linspace(5, 50, 50)
_CURVE = np.polynomial.polynomial.polyfit((0.088 * _GRAMS - 0.0006239 * _GRAMS**2) / FULL, _GRAMS * 9.81e-3 / 4, 2)
ACTUATOR = Actuator(tuple(map(float, _CURVE)), "thrust", (0.06, 0.06), FULL, 1.0)
LAYOUT = Layout(dt=0.01, steps=20, span=0.1, disturbance=(0.0,) * 3 + (0.5,) * 3)
SHORT = replace(LAYOUT, steps=15)


@dataclass(frozen=True)
class Options:
    """Which rotor is damaged, and by how much, in the data set CrazyPAD: a vehicle whose propeller M3 was cut in steps.

    The effectiveness of each rotor is learned from normal flights, then from three seconds of a damaged one, by thrust
    and trim. Since the thrust of a command grows after take-off, damage is measured against the same seconds of normal
    flights, and predictions use the effectiveness of whole normal flights.
    """

    folder: Annotated[Path, tyro.conf.Positional]
    """`motor_data` of the data set, with the folders normal_flight and cut_propeller_M3_…"""


class RecordedFlight(NamedTuple):
    """A flight, and the remaining length [mm] of its propeller M3."""

    recording: Recording
    length: float


def flights(folder: Path, vehicle: str = "E8") -> tuple[list[RecordedFlight], list[RecordedFlight]]:
    normal = [RecordedFlight(read_recording(p), WHOLE) for p in sorted((folder / "normal_flight").glob(f"{vehicle}_*"))]
    found = sorted(folder.glob(f"cut_propeller_M3_*/{vehicle}_*"))
    cut = [RecordedFlight(read_recording(p), float(re.findall(r"([\d.]+)mm", p.parent.name)[-1])) for p in found]
    if not normal or not cut:
        raise ValueError(f"{folder}: no flights normal_flight/{vehicle}_* and cut_propeller_M3_*/{vehicle}_*")
    return normal, sorted(cut, key=lambda each: -each.length)


def force_errors(field: Any, recording: Recording, after: float = 0.0) -> np.ndarray:
    """Measured minus predicted specific force along the thrust [m/s²], in flight, from a time on."""
    command, force = (recording.signals[name] for name in ("command", "specific_force"))
    edges = np.arange(command.t[0], command.t[-1], 0.01)
    speeds = rotor_speeds(field, command.t, inputs_of(recording, field), edges)
    theta = field.body.theta()
    k = np.asarray(theta.get("k_rotors", VEHICLE.thrust_coefficient) * theta.get("efficiency", 1.0))
    t = (edges[1:] + edges[:-1]) / 2
    error = np.interp(t, force.t, np.asarray(force.values)[:, -1]) - (k * speeds**2).sum(axis=1) / VEHICLE.mass
    return error[within(t, airborne(recording)) & (t >= after)]


def source(normal: list[RecordedFlight]) -> Any:
    learn = rigid_body(VEHICLE, ("k_rotors",))
    field = actuated(learn, ACTUATOR, ("time_constant",))
    return identify(field, [each.recording for each in normal], LAYOUT, MEASURED).field


def first_seconds(recording: Recording, seconds: float = SECONDS) -> tuple[Recording, float]:
    begin, _ = airborne(recording)[0]
    return recording.part(begin, begin + seconds), begin + seconds


def take_off(field: Any, normal: list[RecordedFlight]) -> Any:
    """Fit each rotor to normal flights in the seconds after take-off."""
    parts = [first_seconds(each.recording)[0] for each in normal]
    return identify(changed(field, np.zeros(VEHICLE.rotors)), parts, SHORT, MEASURED, free=("efficiency",)).field


def damage(fresh: Any, flight: RecordedFlight) -> tuple[np.ndarray, Float[np.ndarray, " n"], float]:
    """Return each rotor's lost share of thrust in the first seconds, with intervals; log efficiencies; their end.

    All four are estimated from thrust and trim; then only the worst one is fitted to the accelerometer.
    """
    (part, end), whole = first_seconds(flight.recording), np.asarray(fresh.body.deviations["efficiency"])
    found = identify(fresh, [part], SHORT, MEASURED, free=("efficiency",))
    efficiencies = np.array([found.intervals[f"efficiency[{i}]"] for i in range(VEHICLE.rotors)])
    lost = 1 - efficiencies[:, [0, 2, 1]] / np.exp(whole)[:, None]
    worst = f"efficiency[{lost[:, 0].argmax()}]"
    alone: Any = identify(fresh, [part], SHORT, ("specific_force",), free=(worst,)).field
    return lost, np.asarray(alone.body.deviations["efficiency"]) - whole, end


def changed(field: Any, log_efficiency) -> Any:
    body: Any = corrected(field.body, ("efficiency", "added_drag"))
    return replace(field, body=replace(body, deviations=body.deviations | {"efficiency": jnp.asarray(log_efficiency)}))


def run(options: Options) -> None:
    runtime.configure()
    console = Console(width=120)
    normal, cut = flights(options.folder)
    here = source(normal[:3])
    fresh = take_off(here, normal[:3])
    console.print("normal:", {name: np.asarray(value).tolist() for name, value in here.theta().items()})
    lines, shares, found = [], {}, []
    for flight in cut:
        lost, efficiency, end = damage(fresh, flight)
        worst = int(lost[:, 0].argmax())
        alone = 1 - float(np.exp(efficiency[worst]))
        shares.setdefault(flight.length, []).append(alone)
        found.append([rmse(force_errors(each, flight.recording, end)) for each in (here, changed(here, efficiency))])
        value, low, high = lost[worst]
        cells = f"M{worst + 1}" if low > 0 else "none", f"{value:.3f}", f"{low:.3f} … {high:.3f}", f"{alone:.3f}"
        lines.append((f"{WHOLE - flight.length:g}", *cells, *(f"{each:.2f}" for each in found[-1])))
    for row, flight in zip(found, cut, strict=True):
        others = {length: float(np.mean(part)) for length, part in shares.items() if length != flight.length}
        lengths = sorted({WHOLE, *others})
        lost = np.interp(flight.length, lengths, [others.get(length, 0.0) for length in lengths])
        efficiency = np.log1p(-lost * (np.arange(VEHICLE.rotors) == 2))
        row.append(rmse(force_errors(changed(here, efficiency), flight.recording, first_seconds(flight.recording)[1])))
    lines = [(*line, f"{row[2]:.2f}") for line, row in zip(lines, found, strict=True)]
    pooled = np.sqrt(np.mean(np.square(found), axis=0))
    lines.append(("all", "", "", "", "", *(f"{each:.3f}" for each in pooled)))
    header = ("cut [mm]", "rotor", "thrust lost, by thrust and trim", "95 %", "by thrust alone")
    title = f"Damage by {SECONDS:g} s; specific force along the thrust after them, RMSE [m/s²]"
    print_table(console, Table(title, (*header, "from normal", "those seconds", "interpolated"), lines))


main = partial(command.call, "identification.crazypad", Options, run)

if __name__ == "__main__":
    main()
