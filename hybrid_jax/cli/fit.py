"""The verb `hybrid-jax fit`: learn a vehicle from its logs, with a network if it improves predictions."""

import contextlib
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro

from hybrid_jax import checks
from hybrid_jax.cli import errors, identify, page
from hybrid_jax.cli.command import step
from hybrid_jax.cli.help import RARE
from hybrid_jax.cli.inspect import inspected, write_vehicle
from hybrid_jax.cli.logs import FlightOptions, Flights, paths_of, read_flights
from hybrid_jax.dynamics.actuators import NAMES
from hybrid_jax.dynamics.rigid_body import RIGID_BODY_SPACE
from hybrid_jax.dynamics.vehicle_file import LAG, VehicleModel, load_vehicle_model
from hybrid_jax.flights.conversion import DT, missing_states
from hybrid_jax.flights.load import read_recording
from hybrid_jax.identification.learning import CANDIDATES, FROZEN, PAST, STEPS, UNITS, Learned, learn, learnable, ratio
from hybrid_jax.identification.recordings import Layout
from hybrid_jax.io.files import json_value
from hybrid_jax.io.models import save

__all__ = ["Options", "run"]
OF_MODEL = ("windows", "motion")  # not in the report
REMEMBERS = (
    "The model also uses its errors in the seconds before, which show lasting forces, for example of a swinging load, "
    "and noise in the first sample. docs/howto/records.md explains how to pass them."
)
QUANTILES = np.linspace(0.01, 0.99, 99)


@dataclass(frozen=True)
class Options(FlightOptions):
    """Learn a vehicle from the logs of its flights.

    Each flight is held out in turn, to choose between physics only and physics with a network, and to estimate the
    error on a new flight.

    Your logs should have position, velocity, attitude, body rates, and rotor speeds (or commands with --polynomial). If
    some of these are missing, or if there are commands and the vehicle file has a table [actuator], only physics is
    identified. Each parameter then gets a 95 % interval, which is infinite if the logs do not determine it: see
    docs/howto/identify.md.
    """

    before: Annotated[Path, tyro.conf.Positional]
    """Folder of logs."""
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """File for the model."""
    vehicle: Path | None = None
    """Vehicle file: see docs/howto/vehicle.md. It has the known constants and, in `learn`, the names to learn. By
    default, one is estimated from the logs, with a mass of 1 kg and arms of 0.1 m, which scale the results."""
    learn: tuple[str, ...] = ()
    """Parameters to learn, instead of the vehicle file's. If it has none: inertia, thrust and aerodynamics."""
    dt: float | None = None
    """Interval of the model [s]. By default 0.01, or 0.005 if physics is identified."""
    seed: int = 0
    """Random seed of the network."""
    out: Path = Path("runs/fit")
    """Folder for report.html and report.json."""
    steps: Annotated[int, RARE] = 20
    """Identification: steps of a window. Short windows are robust to slow disturbances, long ones identify slow
    effects."""
    windows: Annotated[int, RARE] = 300
    """Identification: largest number of windows. Half are the most informative ones, and half are evenly spaced."""
    disturbance: Annotated[tuple[float, ...], RARE] = Layout.disturbance
    """Identification: initial standard deviation of a window's constant force [m/s²] and torque [rad/s²] along x, y and
    z. You should use 0 for a damaged rotor, because a free torque would absorb its trim."""


def run(options: Options) -> int:
    dt = DT if options.dt is None else options.dt
    checks.positive("--dt", dt)
    path = options.vehicle or options.out / "vehicle.toml"
    if options.vehicle is None:
        with step("estimating a vehicle file, as none is given"):
            seen = inspected(paths_of(options.before)[0], None, replace(options, dt=dt))
            write_vehicle(path, seen, options.before)
    model = load_vehicle_model(path)
    model = replace(model, learn=options.learn or model.learn)
    if not model.learn:
        raise ValueError(f"{path}: learn: is empty; give --learn Ix Iy, or other unknown parameters")
    if _identified(options, model):
        return identify.run(options, path, model)
    lagging = LAG in model.learn or model.terms.motor_time_constant > 0
    flights = read_flights(options.before, model.vehicle, dt, options, lagging=lagging)
    if len(flights.logs) < 2:
        raise ValueError(f"{options.before}: has one flight; you need at least two, because one is held out")
    if flights.still and not options.ignore_checks:
        raise ValueError(f"{options.before}: no flight excites a parameter; fly manoeuvres, or use --ignore-checks")
    model, left = learnable(model, flights.seconds, STEPS * dt)
    with step(f"learning from {len(flights.logs)} flights") as done:
        found = learn(model, flights.logs, options.seed)
        done(f"{found.chosen} predicts them best")
    about = _about(options, model, flights, found) | {"dt": dt}
    save(options.output, found.field, json_value(about))
    record = {name: each for name, each in about.items() if name not in OF_MODEL}
    record |= {"model": options.output, "adaptation": found.physics.to_dict()}
    page.write(options.out, "fit", _page(options, flights, found, dt, left), record)
    return 0


def _identified(options: Options, model: VehicleModel) -> bool:
    """Whether the first readable log is incomplete, or the vehicle file's actuator is used or learned."""
    for path in paths_of(options.before)[0]:
        with contextlib.suppress(ValueError):  # a log that cannot be read is left out later
            found = read_recording(path, **options.reading)
            break
    else:
        return False
    commands = model.actuator is not None and not options.polynomial and "rotor_speed" not in found.signals
    return commands or bool({*missing_states(found)} - {"motors"} or {*model.learn} & {*NAMES})


def _about(options: Options, model: VehicleModel, flights: Flights, found: Learned) -> dict[str, Any]:
    """Collect the metadata of the model that other verbs need."""
    x, u = (np.concatenate([getattr(log, part) for log in flights.logs]) for part in "xu")
    features = RIGID_BODY_SPACE.features(x, u)
    return {
        "steps": STEPS,
        "vehicle": model.vehicle.name,
        "polynomial": list(options.polynomial),
        "lag": found.lag,
        "learned_from": flights.contents,
        "windows": {part: getattr(found.windows, part).tolist() for part in ("x0", "u", "x")},
        "motion": {name: np.quantile(values, QUANTILES).tolist() for name, values in features.items()},
        "chosen": found.chosen,
        "expected": {name: each for name, *each in zip(UNITS, *found.expected, strict=True)},
    }


def _page(options: Options, flights: Flights, found: Learned, dt: float, left: str) -> page.Page:
    seconds, frozen = STEPS * dt, found.left_out[FROZEN][:, -1]
    better = ratio(frozen, found.left_out[found.chosen][:, -1])
    cells = [errors.texts(each) for each in (*found.expected, np.exp(np.log(frozen).mean(axis=0)))]
    rows = [
        (name.replace("_", " "), value, f"{low.partition(chr(160))[0]} to {high}", baseline)
        for name, value, low, high, baseline in zip(UNITS, *cells, strict=True)
    ]
    by_flight = [
        (name, *(f"{ratio(found.left_out[each][i, -1], frozen[i]):.3g}" for each in CANDIDATES))
        for i, name in enumerate(flights.contents)
    ]
    helps = "improves the predictions" if found.chosen.startswith("hybrid") else "does not help"
    return page.Page(
        f"What do {len(flights.logs)} flights of {options.before} show about the vehicle?",
        f"Predictions of {seconds:g} s on held-out flights are {better:.2g} times as accurate as with frozen rates.",
        page.Table(
            f"Expected error after {seconds:g} s on a new flight", ("quantity", "RMSE", "80 % interval", FROZEN), rows
        ),
        [("RMSE on held-out flights", errors.figure(found.left_out, dt))],
        [
            f"The model is {found.chosen}: a network beside the physics {helps}.",
            errors.BASELINE,
            *([REMEMBERS] if found.chosen.endswith(PAST) else []),
            *([f"Rotors follow the motors of the logs with a lag of {1000 * found.lag:.3g} ms."] if found.lag else []),
            *[left] * bool(left),
            *errors.unknown(found.physics),
            *flights.warnings,
        ],
        [f"After a change: hybrid-jax adapt {options.output} AFTER -o adapted.npz, with ten seconds of flight."],
        [
            errors.parameter_table(found.physics),
            page.Table(f"Error on each held-out flight relative to {FROZEN}", ("flight", *CANDIDATES), by_flight),
        ],
        flights.notes,
    )
