"""Folders of logs: read or simulated, checked against the vehicle, cleaned, recorded, and assigned to folds."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Int

from experiments.real_flight.config import Cleaning, RealFlightConfig, read_topics
from experiments.real_flight.models import RECIPES
from experiments.runner.command import ChecksFailed
from hybrid_jax.extrapolation import Motion, motion
from hybrid_jax.flights.checks.cleaning import align_motors, delay_motors, in_flight, lag_motors, low_pass, resample
from hybrid_jax.flights.checks.consistency import FAILS, Check, check_log
from hybrid_jax.flights.checks.suitability import check_recording, failures
from hybrid_jax.flights.load import asked_interval, read_folder
from hybrid_jax.flights.log import FlightLog, gaps, repeats, segments
from hybrid_jax.flights.windows import count_windows, flight_of, folds, hold_out, manoeuvre_of, require_length
from hybrid_jax.io.archive import digest
from hybrid_jax.trajectories import Trajectories
from hybrid_jax.vehicle import Vehicle

MEND = "nothing was trained; mend the logs as the lines above say, or go on with --anyway"
FOLDS, VALIDATION_SHARE = 3, 0.2
LEFT_OUT = 5  # most parts of a fold's flights that are left out of training in turn, which bounds the cost
GROUP_BY = {"flight": flight_of, "manoeuvre": manoeuvre_of}


@dataclass(frozen=True)
class LogSet:
    """The flights of one folder."""

    label: str  # source, target or test
    logs: list[FlightLog]  # after cleaning
    records: list[dict[str, Any]]  # of each flight, as JSON values: see `_record`
    left: Mapping[str, str] = field(default_factory=dict)  # other files of the folder, and why they were not read

    def with_lag(self, time_constant: float) -> "LogSet":
        """The flights with rotors that follow the log's motor values with a first-order lag [s]."""
        logs, lines = zip(*(lag_motors(log, time_constant) for log in self.logs), strict=True)
        records = [each | {"done": [*each["done"], line]} for each, line in zip(self.records, lines, strict=True)]
        return LogSet(self.label, list(logs), records, self.left)


def load_logs(option: str, folder: Path, vehicle: Vehicle, time_constant: float, config: RealFlightConfig) -> LogSet:
    """Read, check and clean all logs of a folder, which the given option named; rotors lag by the time constant [s].

    Raises:
        ChecksFailed: a check failed, without --anyway.
    """
    dt = config.cleaning.resample
    try:
        given = {"columns": config.columns, "topics": read_topics(config.topics), "motor_order": config.motor_order}
        readings, left = read_folder(folder, **given)
    except ValueError as error:
        about_folder = str(error).startswith(f"{folder}: ")
        raise ValueError(f"--{option} {error}" if about_folder else str(error)) from error
    # Before they become flights, which those that fail might not do.
    found = [check_recording(each.recording, vehicle, asked_interval(each, dt)) for each in readings]
    names = [f"{option}/{Path(each.recording.name).name}" for each in readings]
    require_checks(list(zip(names, found, strict=True)), config)
    raws = [each.flight(dt, config.polynomial) for each in readings]
    cleaned = [clean(raw, config.cleaning, vehicle) for raw in raws]
    records = [
        _record(option, raw, *each, [*checks, *check_log(each[0], vehicle)], reading.recording.notes)
        for reading, raw, each, checks in zip(readings, raws, cleaned, found, strict=True)
    ]
    logs = LogSet(option, [log for log, _ in cleaned], records, {path.name: why for path, why in left.items()})
    return logs.with_lag(time_constant) if time_constant else logs


def require_checks(found: Sequence[tuple[str, Sequence[Check]]], config: RealFlightConfig) -> None:
    """Raise ChecksFailed with a line for each check that failed, by the names of their flights; not with --anyway."""
    lines = [line for name, checks in found for line in failures(checks, name)]
    if lines and not config.anyway:
        raise ChecksFailed(*lines, MEND)


def require_distinct(sets: Sequence[LogSet], config: RealFlightConfig) -> None:
    """Refuse a flight that occurs twice, whatever its files are called: it could be in training and test.

    Source and test may share flights where each is tested by models trained on other manoeuvres.
    """
    shared = config.target is None and config.folds_by == "manoeuvre"
    first: dict[tuple[str, str], str] = {}
    for each in sets:
        for log, record in zip(each.logs, each.records, strict=True):
            key, file = (each.label if shared else "", record["sha256"]), f"--{each.label} {log.name}"
            if key in first:
                raise ValueError(f"{file}: the same flight as {first[key]}; leave one of the two out")
            first[key] = file


def clean(log: FlightLog, cleaning: Cleaning, vehicle: Vehicle) -> tuple[FlightLog, list[str]]:
    """Apply the configured changes to a log; also return one line per change."""
    steps: dict[str, tuple[Any, Callable[[FlightLog, Any], tuple[FlightLog, str]]]] = {
        "in-flight": (cleaning.in_flight or None, lambda log, _: in_flight(log)),
        "resample": (cleaning.resample, lambda log, dt: resample(log, dt, cleaning.longest_gap)),
        "low-pass": (cleaning.low_pass, low_pass),
        "align": (cleaning.align or None, lambda log, _: align_motors(log, vehicle)),
        "delay": (cleaning.delay or None, delay_motors),
    }
    done: list[str] = []
    for option, (value, change) in steps.items():
        if value is None:
            continue
        try:
            log, line = change(log, value)
        except ValueError as error:
            why = str(error).removeprefix(f"{log.name}: ")
            raise ValueError(f"{log.name}: --cleaning.{option}: {why}") from error
        done.append(line)
    return log, done


def _record(
    folder: str, raw: FlightLog, log: FlightLog, done: list[str], checks: Sequence[Check], notes: Sequence[str]
) -> dict[str, Any]:
    return {
        "folder": folder,
        "flight": flight_of(raw),
        "sha256": digest(None, {"t": raw.t, "x": raw.x, "u": raw.u}),
        "samples": len(raw),
        "seconds": round(float(raw.t[-1] - raw.t[0]), 3),
        "dt": raw.dt,
        "gaps": int(gaps(raw).sum()),
        "repeated_samples": int(repeats(raw).sum()),
        "used_samples": sum(part.stop - part.start for part in segments(log)),
        "done": done,
        "notes": notes,
        "fails": sum(check.verdict == FAILS for check in checks),
        "checks": [asdict(check) for check in checks],
    }


@dataclass(frozen=True)
class Fold:
    """Disjoint lists of flights; `name` lists what is tested."""

    name: str
    train: list[FlightLog]
    validation: list[FlightLog]
    test: list[FlightLog]


def make_folds(train: Sequence[FlightLog], tested: Sequence[FlightLog] | None, config: RealFlightConfig) -> list[Fold]:
    """Make the folds; without separate test flights, each training flight is held out once."""
    if tested is not None and (config.target is not None or config.folds_by == "flight"):
        return [Fold("test", *hold_out_validation(train, config), list(tested))]
    of = GROUP_BY[config.folds_by]
    names = {of(log) for log in train} & {of(log) for log in tested or train}
    if len(names) < 2:
        none_left = "all flights are of one name, so none is left to train on; give flights to --test"
        raise ValueError(f"--folds-by {config.folds_by}: {none_left}")
    count = min(FOLDS, len(names)) if config.folds is None else config.folds
    try:
        splits = folds([log for log in train if of(log) in names], count, of, config.data_seed)
    except ValueError as error:
        raise ValueError(f"--folds: {error}") from error

    def fold(held_out: Sequence[FlightLog]) -> Fold:
        held = sorted({of(log) for log in held_out})
        rest = [log for log in train if of(log) not in held]
        test = [log for log in tested or train if of(log) in held]
        return Fold(", ".join(held), *hold_out_validation(rest, config), test)

    return [fold(held_out) for _, held_out in splits]


def hold_out_validation(
    logs: Sequence[FlightLog], config: RealFlightConfig, by: str | None = None
) -> tuple[list[FlightLog], list[FlightLog]]:
    """Split flights into training and validation: a fifth of the names, but at least one, is for validation."""
    by = by or config.validated_by
    of = GROUP_BY[by]
    names = sorted({of(log) for log in logs})
    if len(names) < 2:
        few = f"{len(logs)} flights of one name ({names[0]}) are too few to leave one out, for validation and to choose"
        other = "; use --validate-by flight" if by == "manoeuvre" and len(logs) > 1 else "; add a flight"
        raise ValueError(f"--validate-by {by}: {few}{other}")
    count = max(1, round(VALIDATION_SHARE * len(names)))
    dealt = np.random.default_rng(config.data_seed).permutation(np.array(names, object))
    return hold_out(logs, list(dealt[:count]), of)


def leave_out(fold: Fold, config: RealFlightConfig) -> list[Fold]:
    """Folds of a fold's own flights but those tested: each is left out of training once, as `validated_by` says.

    Of the flights left, some stop the training, by flight if they are of one manoeuvre. A single one stops its own.
    """
    of = GROUP_BY[config.validated_by]

    def split(rest: list[FlightLog]) -> tuple[list[FlightLog], list[FlightLog]]:
        by = config.validated_by if len({of(log) for log in rest}) > 1 else "flight"
        return hold_out_validation(rest, config, by) if len(rest) > 1 else (rest, rest)

    logs = [*fold.train, *fold.validation]
    parts = folds(logs, min(LEFT_OUT, len({of(log) for log in logs})), of, config.data_seed)
    return [Fold(", ".join(sorted({of(log) for log in held})), *split(rest), held) for rest, held in parts]


def require_windows(folds: Sequence[Fold], source: Fold | None, config: RealFlightConfig) -> None:
    """Refuse, before anything is trained, flights that are too short; with a source, folds hold flights to adapt to."""
    longest = max(RECIPES[name].window for name in config.tried)
    for fold in filter(None, (source, *folds)):
        require_length(fold.train, longest)
        require_length(fold.validation, longest)
    for fold in folds:
        require_length(fold.test, config.longest)
        require_length([*fold.train, *fold.validation], config.longest)
        for inner in leave_out(fold, config):
            require_length(inner.train, longest)
            require_length(inner.validation, longest)
            count = count_windows(inner.train, longest) // (1 if source else config.stride)
            if count < config.batch_size:
                few = f"without {inner.name}, the flights have only {count} windows to train on"
                raise ValueError(f"--batch-size {config.batch_size}: {few}; add flights or give a smaller one")
        size, count = max(config.n), count_windows(fold.train, longest)
        if source and size > count:
            raise ValueError(f"--n {size}: the training flights have only {count} windows; give a smaller --n")


def evenly_spaced(windows: Trajectories, count: int) -> Trajectories:
    """Pick `count` evenly spaced windows; if there are fewer, some occur twice, so that all folds share one shape."""
    return windows[np.linspace(0, len(windows) - 1, count).round().astype(int)]


def sampled_indices(sizes: Sequence[int], size: int, draw: str, seed: int) -> Int[np.ndarray, " size"]:
    """Sample the indices of the training windows of one run, from flights of so many windows each.

    Random draws are of any windows; smaller sizes are prefixes of larger ones. Contiguous draws are consecutive windows
    of one flight, or where no flight is that long, whole flights and a part of another. There are as many windows.
    """
    if draw == "random":
        return np.random.default_rng(seed).permutation(sum(sizes))[:size]
    starts, left = np.cumsum([0, *sizes]), np.array(sizes)
    taken: list[np.ndarray] = []
    while size > max(left):
        flight = int(np.random.default_rng((seed, len(taken))).choice(np.flatnonzero(left)))
        taken.append(np.arange(starts[flight], starts[flight + 1]))
        size, left[flight] = size - left[flight], 0
    if size:
        # Every place where the rest fits into a flight is equally likely.
        places = np.cumsum(np.maximum(left - size + 1, 0))
        at = int(np.random.default_rng(seed).integers(places[-1]))
        flight = int(np.searchsorted(places, at, side="right"))
        begin = starts[flight] + at - (places[flight - 1] if flight else 0)
        taken.append(np.arange(begin, begin + size))
    return np.concatenate(taken)


def non_overlapping(indices: np.ndarray, sizes: Sequence[int], spacing: int) -> np.ndarray:
    """Thin out windows until those of one flight are at least `spacing` apart, so that they share no sample."""
    kept: list[tuple[int, int]] = [(-1, 0)]
    ordered = np.sort(indices)
    flights = np.searchsorted(np.cumsum(sizes), ordered, side="right")
    for flight, index in zip(flights.tolist(), ordered.tolist(), strict=True):
        if flight != kept[-1][0] or index - kept[-1][1] >= spacing:
            kept.append((flight, index))
    return np.array([index for _, index in kept[1:]], int)


def motion_of_logs(logs: Sequence[FlightLog]) -> Motion:
    """`motion` of every sample of some logs."""
    x, u = (np.concatenate([getattr(log, name) for log in logs]) for name in "xu")
    return motion(x, u, rigid=True)
