"""Read logs of a folder, check them, and cut them into flights and windows, for every verb."""

import itertools
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np

from hybrid_jax.cli.command import ChecksFailed, step
from hybrid_jax.cli.help import RARE
from hybrid_jax.flights.checks.cleaning import Cleaning, clean
from hybrid_jax.flights.checks.consistency import GYRO, RATIO, Check, check_log
from hybrid_jax.flights.checks.suitability import check_recording, failures
from hybrid_jax.flights.conversion import flight_at
from hybrid_jax.flights.load import find_logs, read_recording
from hybrid_jax.flights.log import FlightLog, unevenness
from hybrid_jax.flights.recording import Recording
from hybrid_jax.flights.windows import LogWindows, cut_windows, require_length
from hybrid_jax.io.archive import digest
from hybrid_jax.vehicle import Vehicle

LISTS = ("--polynomial", "--motor-order", "--topics", "--learn")
STEPS = 10  # intervals of a window
ONE_TO_ONE = (0.0, 1.0)  # rotor speed = command, in whatever unit: motors are still compared with the motion
CUT = ("time on the ground",)  # is cut out
CHANGED = 2.0  # factor by which thrust may differ from the vehicle's where a change is asked for
BORNE = {RATIO: lambda ratio: 1 / CHANGED < ratio < CHANGED, GYRO: lambda lag: lag > 0}  # values that may be right


@dataclass(frozen=True, kw_only=True)
class LogOptions:
    """Options for reading logs."""

    columns: Path | None = None
    """TOML file of the columns, units and frames of CSV logs: see docs/howto/logs.md."""
    topics: tuple[str, ...] = ()
    """Topics of ROS bags, for example odometry=/odom motors=/rotors:data:rpm; also pose, imu, voltage."""
    motor_order: tuple[int, ...] = ()
    """Index in the log of each rotor's motor, from 0, for example 2,0,3,1."""

    @property
    def reading(self) -> dict[str, Any]:
        """Arguments of the functions of `hybrid_jax.flights.load`; raises ValueError for malformed topics."""
        for word in self.topics:
            if "=" not in word:
                raise ValueError(f"topics must be pairs like odometry=/odom, got {word!r}")
        topics = dict(word.split("=", 1) for word in self.topics)
        return {"columns": self.columns, "topics": topics, "motor_order": self.motor_order}


@dataclass(frozen=True, kw_only=True)
class SpeedOptions(LogOptions):
    """Options for reading logs for models whose inputs are rotor speeds."""

    polynomial: tuple[float, ...] = ()
    """For logs with commands but no rotor speeds: rotor speed [rad/s] = c0 + c1 command + c2 command² …, with commands
    from 0 (stop) to 1 (full). You can measure it on a test stand, or at two points: 100,1000 if a motor starts at
    100 rad/s and reaches 1100 at full command. PWM (1000 … 2000 µs) and DShot are scaled to 0 … 1 first."""
    delay: Annotated[float, RARE] = 0.0
    """Delay to add to the motors [s], if a check found that they lead the gyro."""


@dataclass(frozen=True, kw_only=True)
class FlightOptions(SpeedOptions):
    """Options for converting logs to flights."""

    anyway: bool = False
    """Also use logs that fail checks; the page then warns about them."""


class Flights(NamedTuple):
    """The flights of a folder, at one interval.

    Attributes:
        logs: airborne flights of the logs that passed.
        contents: digests of the flights' contents by name.
        said: lines on logs that were read, left out or cut.
    """

    logs: list[FlightLog]
    contents: dict[str, str]
    said: list[str]

    @property
    def seconds(self) -> float:
        """Total time in the air [s]."""
        return sum(len(log) * log.dt for log in self.logs)


class Looked(NamedTuple):
    """A checked log and its flight.

    Attributes:
        log: its airborne flight, or None.
        checks: checks of its signals, except what every verb corrects.
        refusal: why it is not a flight, or empty.
        notes: what was cut.
    """

    log: FlightLog | None
    checks: list[Check]
    refusal: str
    notes: list[str]


def require_distinct(flights: Sequence[tuple[str, Any]]) -> None:
    """Raise ValueError if a flight occurs twice, as it could be in training and test; pass names and contents."""
    first: dict[Any, str] = {}
    for name, content in flights:
        if content in first:
            raise ValueError(f"{name}: the same flight as {first[content]}; leave one of the two out")
        first[content] = name


def require_unseen(learned_from: Mapping[str, str], contents: Mapping[str, str]) -> None:
    """Raise ValueError for a flight that a model was trained on."""
    names = {content: name for name, content in learned_from.items()}
    for name, content in contents.items():
        if content in names:
            raise ValueError(
                f"{name}: the same flight as {names[content]}, which the model was trained on; leave it out"
            )


def content_of(recording: Recording) -> str:
    """Identify a recording by its content, whatever its file's name."""
    parts = itertools.product(recording.signals.items(), ("t", "values"))
    return digest(None, {f"{name} {part}": getattr(signal, part) for (name, signal), part in parts})


def raw_logs(folder: Path, read: Callable[[Path], Any]) -> tuple[list[tuple[Path, Any]], list[str]]:
    """Apply `read` to each log of a folder, or to one log; also return a line for each skipped file."""
    if not folder.exists():
        raise ValueError(f"{folder}: no such file or folder")
    paths, others = find_logs(folder) if folder.is_dir() else ([folder], {})
    left = [f"{path.name}: left: {why}" for path, why in others.items()]
    if not paths:
        raise ValueError(f"{folder}: contains no logs, only {'; '.join(left) or 'nothing'}")
    return [(path, read(path)) for path in paths], left


def read_flights(
    folder: Path, vehicle: Vehicle, dt: float, options: FlightOptions, changed: bool = False, lagging: bool = False
) -> Flights:
    """Read, check and cut logs; failed ones are left out with a line.

    `changed` tolerates another thrust, and `lagging` motors that lead the gyro because the model includes their lag.
    """
    with step(f"reading {folder}") as told:
        raws, said = raw_logs(folder, lambda path: read_recording(path, **options.reading))
        contents = {path.name: content_of(raw) for path, raw in raws}
        require_distinct(list(contents.items()))
        logs, failed = [], []
        for path, raw in raws:
            one = look(path, raw, vehicle, dt, options, changed, lagging)
            lines = failures(one.checks, path.name) or [f"{path.name}: no flight: {one.refusal}"] * bool(one.refusal)
            said += [f"{path.name}: {note}" for note in (*raw.notes, *one.notes)]
            failed += lines
            if one.log is not None and (options.anyway or not lines):
                logs.append(one.log)
            else:
                del contents[path.name]
        for line in failed:
            print(f"  {line}", file=sys.stderr)
        if not logs:
            raise ChecksFailed(
                *failed, "no log passed its checks; correct them as the lines above say, or use --anyway"
            )
        found = Flights(logs, contents, said + failed)
        told(f"{len(logs)} of {len(raws)} flights, {found.seconds:.0f} s in the air")
    return found


def look(
    path: Path,
    raw: Recording,
    vehicle: Vehicle | None,
    dt: float,
    options: SpeedOptions,
    changed: bool = False,
    lagging: bool = False,
) -> Looked:
    """Check a log and cut it to its flight; if the vehicle cannot be used, it is compared with itself."""
    checks, notes = check_recording(raw, vehicle, dt), []
    scaled = "rotor_speed" in raw.signals or bool(options.polynomial)
    try:
        log = flight_at(raw, dt, options.polynomial if scaled else ONE_TO_ONE)
        fits = log.dt == dt and not unevenness(log).any()
        log, notes = clean(log, Cleaning(in_flight=True, resample=None if fits else dt, delay=options.delay))
        other = vehicle is not None and log.u.shape[1] != vehicle.rotors  # a check that failed says so
        checks += check_log(log, None if other or not scaled else vehicle)
        require_length([log], STEPS)
        if not scaled:
            flight_at(raw, dt)  # says what is missing
        refusal = ""
    except ValueError as error:
        log, refusal = None, str(error).removeprefix(f"{path}: ")
    borne = {RATIO: changed, GYRO: lagging}
    excused = [each for each in checks if each.name in CUT or (borne.get(each.name) and BORNE[each.name](each.value))]
    return Looked(log, [each for each in checks if each not in excused], refusal, notes)


def windows_of(logs: Sequence[FlightLog], steps: int, stride: int, most: int | None = None) -> LogWindows:
    """Cut flights into windows and keep at most `most`, evenly spaced."""
    found = cut_windows(list(logs), steps, stride)
    if most is None or len(found) <= most:
        return found
    kept = np.round(np.linspace(0, len(found) - 1, most)).astype(int)
    of = np.repeat(np.arange(len(found.sizes)), found.sizes)[kept]
    sizes = [int(np.sum(of == i)) for i in range(len(found.sizes))]
    return LogWindows(found.windows[kept], sizes, stride)
