"""Read logs and models, check them, and cut logs into flights and windows, for every verb."""

import itertools
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np

from hybrid_jax.cli.command import ChecksFailed, in_flags, printable, step
from hybrid_jax.cli.help import RARE
from hybrid_jax.dynamics.base import AbstractVectorField
from hybrid_jax.dynamics.rigid_body import RIGID_BODY_SPACE, vehicle_in
from hybrid_jax.flights import Recording, find_logs, read_recording
from hybrid_jax.flights.checks.cleaning import Cleaning, clean, lag_motors
from hybrid_jax.flights.checks.consistency import (
    FAILS,
    GYRO,
    ORDER,
    RATES,
    RATIO,
    THRUST,
    UNKNOWN,
    WARNS,
    Check,
    check_log,
)
from hybrid_jax.flights.checks.suitability import ROTORS, check_recording
from hybrid_jax.flights.conversion import flight_at
from hybrid_jax.flights.formats.column_map import load_column_map
from hybrid_jax.flights.log import FlightLog, unevenness
from hybrid_jax.flights.windows import require_length
from hybrid_jax.identification.learning import STEPS
from hybrid_jax.io.files import digest
from hybrid_jax.io.models import Model
from hybrid_jax.trajectories import WARN, shares_outside
from hybrid_jax.vehicle import Vehicle

ONE_TO_ONE = (0.0, 1.0)  # rotor speed = command, in any unit, to compare motors with the motion
CUT = ("time on the ground",)  # checks that do not matter, because this time is cut out
CHANGED = 2.0  # factor by which thrust may differ from the vehicle's after a change
BORNE = {RATIO: lambda ratio: 1 / CHANGED < ratio < CHANGED, GYRO: lambda lag: lag > 0}  # values that may be right


@dataclass(frozen=True, kw_only=True)
class LogOptions:
    """Options for reading logs."""

    columns: Path | None = None
    """TOML file that describes the columns of CSV logs. It states units and frames, too: see docs/howto/logs.md."""
    topics: tuple[str, ...] = ()
    """ROS topics: odometry=/odom motors=/rotors:data:rpm …. You can also name pose, imu and voltage."""
    motor_order: tuple[int, ...] = ()
    """Index of each rotor's motor in the log, for example 2,0,3,1. Indices begin with 0."""
    polynomial: tuple[float, ...] = ()
    """c0, c1, …: rotor speed [rad/s] = c0 + c1 command …. You need it for logs with commands, 0 (stop) to 1 (full), but
    no rotor speeds. You can measure it on a test stand, or at two points: give 100,1000 if a motor starts at 100 rad/s
    and reaches 1100 at full command. PWM (1000 … 2000 µs) and DShot are scaled to 0 … 1 first."""
    delay: Annotated[float, RARE] = 0.0
    """Delay to add to the motors [s], if a check found that they lead the gyro."""

    @property
    def reading(self) -> dict[str, Any]:
        """The arguments of functions of `hybrid_jax.flights.load`; ValueError if one is malformed."""
        if self.columns is not None:
            load_column_map(self.columns)
        for word in self.topics:
            if "=" not in word:
                raise ValueError(f"topics must be pairs like odometry=/odom, got {word!r}")
        topics = dict(word.split("=", 1) for word in self.topics)
        return {"columns": self.columns, "topics": topics, "motor_order": self.motor_order}


@dataclass(frozen=True, kw_only=True)
class FlightOptions(LogOptions):
    """Options for converting logs to flights."""

    ignore_checks: bool = False
    """Also use logs that fail checks. The page then warns about them."""


class Flights(NamedTuple):
    """The flights of a folder, at one interval."""

    logs: list[Any]  # the logs that passed: flights in the air, or recordings
    contents: dict[str, str]  # digests by name
    notes: list[str]  # lines on logs that were read, left out or cut
    warnings: Sequence[str] = ()  # of checks
    still: bool = False  # whether no log has enough motion to be checked against itself

    @property
    def seconds(self) -> float:
        """Total time in the air [s]."""
        return sum(len(log) * log.dt for log in self.logs)


class Looked(NamedTuple):
    name: str
    recording: Recording | None = None
    checks: Sequence[Check] = ()  # of its signals, except for what every verb corrects
    problem: str = ""  # why it cannot be read, or is not a flight
    notes: Sequence[str] = ()  # what was repaired and cut
    log: FlightLog | None = None  # airborne

    @property
    def failed(self) -> list[Check]:
        return [check for check in self.checks if check.verdict == FAILS]


def require_distinct(flights: Sequence[tuple[str, Any]]) -> None:
    """Raise ValueError if a flight occurs twice, because it could be in training and test; pass names and contents."""
    first: dict[Any, str] = {}
    for name, content in flights:
        if first.setdefault(content, name) != name:
            raise ValueError(f"{name}: the same flight as {first[content]}; leave one of the two out")


def require_unseen(learned_from: Mapping[str, str], contents: Mapping[str, str]) -> None:
    """Raise ValueError for a flight that a model was trained on."""
    names = {content: name for name, content in learned_from.items()}
    for name, content in contents.items():
        if content in names:
            known = f"{name}: the same flight as {names[content]}, which the model was trained on"
            raise ValueError(f"{known}; leave it out")


def content_of(recording: Recording) -> str:
    """Identify a recording by its content, whatever its file's name."""
    parts = itertools.product(recording.signals.items(), ("t", "values"))
    return digest(None, {f"{name} {part}": getattr(signal, part) for (name, signal), part in parts})


def paths_of(folder: Path) -> tuple[list[Path], list[str]]:
    """Return the logs of a folder, or one log, and a line for each other file."""
    if not folder.exists():
        raise ValueError(f"{folder}: no such file or folder")
    paths, others = find_logs(folder) if folder.is_dir() else ([folder], {})
    left = [f"{path.name}: {why}" for path, why in others.items()]
    if not paths:
        raise ValueError(f"{folder}: contains no logs{', only ' * bool(left)}{'; '.join(left[:5])}")
    return paths, left


def recordings_of(folder: Path, options: LogOptions) -> tuple[dict[str, Recording], dict[str, str], list[str]]:
    """Read the logs of a folder, or one log; return recordings and digests by file name, and a line for other files.

    An unreadable log is left out with a line, but ValueError if all are unreadable.
    """
    paths, notes = paths_of(folder)
    found, unread, reading = {}, [], options.reading
    for path in paths:
        try:
            found[path.name] = read_recording(path, **reading)
        except ValueError as error:
            unread.append(f"left out: {error}")
    if not found:
        raise ValueError(unread[0].removeprefix("left out: "))
    for line in unread:
        print(f"  {printable(in_flags(line))}", file=sys.stderr)
    contents = {name: content_of(log) for name, log in found.items()}
    require_distinct([*contents.items()])
    return found, contents, notes + unread


def read_flights(
    folder: Path, vehicle: Vehicle, dt: float, options: FlightOptions, changed: bool = False, lagging: bool = False
) -> Flights:
    """Read, check and cut logs; failed ones are left out with a line.

    With `changed`, thrust may differ; with `lagging`, motors may lead the gyro, because the model includes their lag.
    """
    with step(f"reading {folder}") as done:
        raws, contents, notes = recordings_of(folder, options)
        logs: list[FlightLog] = []
        failed: list[tuple[str, str, str]] = []  # a log, a check and its suggestion
        warned: list[tuple[str, str, str]] = []
        moving = False
        for name, raw in raws.items():
            one = look(Path(raw.name), raw, vehicle, dt, options, changed, lagging)
            lines = [(name, each.name, each.suggestion) for each in one.failed]
            failed += (lines := lines or [(name, "no flight", one.problem)] * bool(one.problem))
            own = *one.notes, *(f"{check}: {why}" for _, check, why in lines)
            notes += [f"{name}: {in_flags(line)}" for line in own]
            if one.log is not None and (options.ignore_checks or not lines):
                logs.append(one.log)
                warned += [(name, each.name, each.suggestion) for each in one.checks if each.verdict == WARNS]
                moving |= {each.verdict for each in one.checks if each.name in (RATES, THRUST, ORDER)} != {UNKNOWN}
            else:
                del contents[name]
        short = grouped(failed)
        if not logs:
            other = all({RATIO, ROTORS} & {check for log, check, _ in failed if log == name} for name in raws)
            why = f"; or are they of another vehicle than {vehicle.name}?" * other
            raise ChecksFailed(*short, f"no log passed its checks; correct them, or use --ignore-checks{why}")
        for line in short:
            print(f"  {printable(in_flags(line))}", file=sys.stderr)
        found = Flights(logs, contents, notes, list(map(in_flags, grouped(warned))), not moving)
        done(f"{len(logs)} of {len(raws)} flights, {found.seconds:.0f} s in the air")
    return found


def grouped(lines: Sequence[tuple[str, str, str]]) -> list[str]:
    """Return a line for each check that logs failed: the suggestion for the first, and the number of others."""
    checks: dict[str, list[str]] = {}
    for name, check, suggestion in lines:
        checks.setdefault(check, []).append(f"{name}: {check}: {suggestion}")
    return [first + f" (and {len(more)} more of the logs)" * bool(more) for first, *more in checks.values()]


def look(
    path: Path,
    raw: Recording,
    vehicle: Vehicle | None,
    dt: float,
    options: LogOptions,
    changed: bool = False,
    lagging: bool = False,
) -> Looked:
    """Check a log and cut it to its flight; if the vehicle cannot be used, the log is only compared with itself."""
    checks, notes, log, problem = check_recording(raw, vehicle, dt), [], None, ""
    scaled = "rotor_speed" in raw.signals or bool(options.polynomial)
    try:
        log = flight_at(raw, dt, options.polynomial if scaled else ONE_TO_ONE)
        fits = log.dt == dt and not unevenness(log).any()
        log, cut = clean(log, Cleaning(in_flight=True, resample=None if fits else dt, delay=options.delay))
        notes = [line for line in cut if not line.startswith("0 ")]
        other = vehicle is not None and log.u.shape[1] != vehicle.rotors  # which a check has reported
        checks += check_log(log, None if other or not scaled else vehicle)
        require_length([log], STEPS)
        if not scaled:
            flight_at(raw, dt)  # raises an error that names what is missing
    except ValueError as error:
        log, problem = None, str(error).removeprefix(f"{path}: ")
    borne = {RATIO: changed, GYRO: lagging}
    excused = [each for each in checks if each.name in CUT or (borne.get(each.name) and BORNE[each.name](each.value))]
    kept = [each for each in checks if each not in excused]
    return Looked(path.name, raw, kept, problem, [*raw.notes, *notes], log)


class Known(NamedTuple):
    """A model of a vehicle, with its constants and the metadata written by `fit`."""

    field: AbstractVectorField
    vehicle: Vehicle
    about: Mapping[str, Any]
    dt: float
    steps: int


def known_of(path: Path, model: Model) -> Known:
    """Convert a model from a file; ValueError if `fit` or `adapt` did not write it."""
    vehicle = vehicle_in(model.field)
    if "identified" in model.about:
        raise ValueError(f"{path}: was identified without the states that replay draws; use hybrid-jax check")
    if vehicle is None or not {"dt", "steps", "learned_from", "motion", "windows"} <= model.about.keys():
        raise ValueError(f"{path}: is not a model written by hybrid-jax fit or adapt")
    return Known(model.field, vehicle, model.about, model.about["dt"], model.about["steps"])


def flights_for(known: Known, folder: Path, options: FlightOptions, changed: bool, unseen: bool = True) -> Flights:
    """Read flights as for the training of a model; if `unseen`, ValueError if it was trained on one of them."""
    polynomial = options.polynomial or tuple(known.about.get("polynomial", ()))
    lag, options = known.about.get("lag", 0.0), replace(options, polynomial=polynomial)
    found = read_flights(folder, known.vehicle, known.dt, options, changed, lag > 0)
    require_unseen(known.about["learned_from"] if unseen else {}, found.contents)
    return found._replace(logs=[lag_motors(log, lag) for log in found.logs])


def unlike(known: Known, flights: Flights) -> list[str]:
    """Warn about quantities that are often outside the training range."""
    learned = {name: np.asarray(values) for name, values in known.about["motion"].items()}
    x, u = (np.concatenate([getattr(log, part) for log in flights.logs]) for part in ("x", "u"))
    shares = shares_outside(learned, RIGID_BODY_SPACE.features(x, u))
    listed = ", ".join(f"{name.partition(' [')[0]} {share:.0%}" for name, share in shares.items() if share > WARN)
    more = "of the time; errors there may be larger than expected."
    return [f"These flights have motion that the training flights did not have: {listed} {more}"] if listed else []
