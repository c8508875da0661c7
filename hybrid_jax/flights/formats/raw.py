"""Samples in ticks of a log's clock, and their conversion to the signals of a `Recording`."""

import bisect
import contextlib
import gzip
import io
import math
import zlib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import IO, NamedTuple

import numpy as np
from jaxtyping import Float

from hybrid_jax.flights.attitude import BODIES, WORLDS, quaternion_from_matrix, rotation_of
from hybrid_jax.flights.log import LARGEST, unlike_one
from hybrid_jax.flights.recording import GAP, Recording, Signal, axes_of

GZIP = b"\x1f\x8b"
LATE = 0.1  # s; a time further behind is a restarted clock instead of a late sample
SHARED = 0.1  # share of samples with the time of the previous one above which times have too few digits
FEW_DIGITS = "it has too few digits, for example from %g: write it with nine after the point, or as whole µs"
# Counters that may wrap: their names, and their range in seconds.
WRAPS = {f"{bits} bits of {unit}": 2**bits * tick for bits in (16, 32) for unit, tick in (("µs", 1e-6), ("ms", 1e-3))}
STRAY = 0.01  # share of samples whose time stamps may be wrong
APART = 0.5  # share of a log's time by which a few samples at an end must be apart to be strays
LOST = 0.5  # share of samples that may be left out because they are not a number or a rotation
FEWEST_OF_LINES = 100  # samples; fewer may be on lines by chance
STRAIGHT = 1e-6  # relative change of a line's slope at a sample that rounding may cause
BENT = 0.5  # share of samples with a bend above which a signal was not interpolated
WHOLE = 1e-3  # distance of a number of steps from an integer that rounding may cause
HELD = 1.5  # mean number of equal rows above which slow samples were repeated
REGULAR = 0.9  # share of the values that must be repeated equally often, or once more or less
OPTIONAL = ("voltage",)  # quantities of which any number of samples may be left out
AS_TOLD = ("command", "voltage")  # quantities that may be constant for a while
RATIO, MOST, SMALL = 100, 2**31, 2**24  # limits of unpacked bytes: over packed ones, at most, at least


class Samples(NamedTuple):
    """n samples of one quantity at integer or real ticks, and their source for messages."""

    ticks: np.ndarray
    values: Float[np.ndarray, "n k"]
    source: str


Parts = tuple[Mapping[str, Samples], float, Sequence[str], Mapping[str, str]]  # what readers give to `record`


class Unpacked:
    """Counts the unpacked bytes of a file or folder; ValueError if there are too many for a log."""

    def __init__(self, path: Path):
        files = path.rglob("*") if path.is_dir() else [path]
        self.most = self.left = min(max(RATIO * sum(each.stat().st_size for each in files), SMALL), MOST)

    def count(self, size: int) -> int:
        self.left -= size
        if self.left < 0:
            raise ValueError(f"unpacks to more than {self.most / 2**20:.0f} MiB; unpack it first if it is a log")
        return size


class _Gzip(io.RawIOBase):
    """The bytes of a gzip file, up to the largest size of a log."""

    def __init__(self, path: Path, packed: IO[bytes]):
        self.file, self.unpacked = gzip.GzipFile(fileobj=packed), Unpacked(path)

    def readable(self) -> bool:
        return True

    def readinto(self, buffer) -> int:
        return self.unpacked.count(self.file.readinto1(buffer))


@contextlib.contextmanager
def readable(path: str | Path, unpack: bool = True) -> Iterator[IO[bytes]]:
    """Open a file, plain or gzip; raise ValueError, with what to do, if it cannot be read."""
    path = Path(path)
    try:
        if path.exists() and not path.is_file():
            raise OSError(0, "is not a regular file")  # a pipe or a device may never end
        with path.open("rb") as plain:
            packed = unpack and plain.read(2) == GZIP
            plain.seek(0)
            yield io.BufferedReader(_Gzip(path, plain)) if packed else plain
    except FileNotFoundError as error:
        raise ValueError("no such file") from error
    except (EOFError, zlib.error) as error:
        raise ValueError("the gzip data are truncated or damaged; copy the file again") from error
    except OSError as error:
        raise ValueError(f"cannot be read: {error.strerror or error}") from error


def record(
    path: str | Path,
    parts: Mapping[str, Samples],
    tick: float = 1.0,
    notes: Sequence[str] = (),
    facts: Mapping[str, str] | None = None,
) -> Recording:
    """Convert samples by quantity, on a clock of `tick` seconds, to a recording.

    Samples are left out, with a note, if they repeat a time stamp, are up to `LATE` out of order, have an outlying time
    or are not a number or a rotation. They become gaps. The first of several samples with equal times is kept.
    """
    parts = {name: part for name, part in parts.items() if len(part.ticks)}
    if not parts:
        remarks = "".join(f" ({note})" for note in notes)
        raise ValueError(f"contains no quantity of a flight{remarks}; see docs/howto/logs.md for what to log")
    remarks, signals, ordered = list(notes), {}, {}
    for name, part in parts.items():
        kept, lines = _in_order(part.source, part.ticks, tick)
        same = np.flatnonzero(np.diff(part.ticks) == 0)
        if (part.values[same + 1] != part.values[same]).any(axis=1).sum() > SHARED * len(part.ticks):
            raise ValueError(f"{part.source}: many samples share a time: {FEW_DIGITS}")
        ordered[name] = part._replace(ticks=part.ticks[kept], values=part.values[kept])
        remarks += [f"{part.source}: {line}: left out" for line in lines]
    start = min(part.ticks[0] for part in ordered.values())
    lost = _lost("attitude", ordered["attitude"]) if "attitude" in ordered else np.ones(1, bool)
    for name, part in ordered.items():
        t, gone = (part.ticks - start).astype(float) * tick, _lost(name, part)
        beside = ordered.get("attitude", part)
        if part.source.split()[:1] == beside.source.split()[:1] and np.array_equal(part.ticks, beside.ticks):
            gone |= lost if lost.mean() <= LOST else False  # a message without an attitude lacks the position, too
        if gone.any() and (name in OPTIONAL or gone.mean() <= LOST):
            why = f"{name} is not a {'rotation' if name == 'attitude' else 'number'} in {gone.sum()} samples"
            remarks.append(f"{part.source}: {why}, the first at {t[gone][0]:.4g} s: left out")
            t, part = t[~gone], part._replace(values=part.values[~gone])
        elif gone.any():
            raise ValueError(f"{part.source}: {_wrong(name, part, int(gone.argmax()), t)}")
        own, values = own_samples(t, part.values, name not in AS_TOLD)
        if len(own) < len(t):
            apart = float(np.median(np.diff(own)))
            drawn = f"values repeated, or lines between samples {apart:.3g} s apart"
            remarks.append(f"{part.source}: {drawn}: read as these samples")
        if len(t):
            signals[name] = Signal(own, values, axes_of(name, values.shape[1]), part.source)
    return Recording(str(path), signals, tuple(dict.fromkeys(remarks)), facts or {})


def _lost(name: str, part: Samples) -> np.ndarray:
    """Whether each sample is not a number, far out of range, or not a rotation."""
    lost = np.asarray(~(np.abs(np.asarray(part.values)) < LARGEST).all(axis=1))
    return lost | np.asarray(unlike_one(part.values)) if name == "attitude" else lost


def _wrong(name: str, part: Samples, row: int, t: np.ndarray) -> str:
    values, at = part.values[row], f"at {t[row]:.6g} s"
    if name == "attitude":
        with np.errstate(over="ignore"):
            return f"the quaternion {at} has norm {np.linalg.norm(values):.4g}, must be 1"
    column = int((~(np.abs(values) < LARGEST)).argmax())
    return f"{axes_of(name, len(values))[column]} is {values[column]:.6g} {at}, must be a number below {LARGEST:g}"


def _in_order(where: str, ticks: np.ndarray, tick: float) -> tuple[np.ndarray, list[str]]:
    """Return the indices of samples later than all before them, and notes about the others."""
    t = (ticks - ticks[len(ticks) // 2]).astype(float) * tick
    for row in np.flatnonzero(~np.isfinite(t))[:1]:
        raise ValueError(f"{where}: the time of sample {row} is {t[row]}, must be finite")
    kept, lines = np.arange(len(t)), []
    steps = np.diff(t)
    usual = float(np.median(steps[steps > 0])) if (steps > 0).any() else 0.0
    far, few = max(LATE, GAP * usual), max(1.0, STRAY * len(t))
    if (np.maximum.accumulate(t) - t).max() > far:
        kept = longest_rise(t)
    ends = np.diff(t[kept])
    if len(ends) > 2 * GAP and ends.max() > max(far, APART * (t[kept[-1]] - t[kept[0]])):
        before, after = np.split(kept, [int(ends.argmax()) + 1])
        kept = after if len(before) <= few else before if len(after) <= few else kept
    if 0 < (stray := len(t) - len(kept)) <= few:
        lines.append(f"{stray} samples with a time far from their neighbours'")
    else:
        kept = np.arange(len(t))
    latest = np.maximum.accumulate(t[kept])
    back = latest - t[kept]
    row = int(back.argmax())
    why = wrapped(usual - np.diff(t[kept]).min(initial=0.0))
    if why or back[row] > far:
        why = why or "the clock was set back or a log appended"
        # From the start of the log.
        times = f"{latest[row] - t[0]:.6g} s to {t[kept][row] - t[0]:.6g} s"
        raise ValueError(f"{where}: time goes back from {times}: {why}; split the file there")
    rising = np.append(True, t[kept][1:] > latest[:-1])
    late, repeated = int((back > 0).sum()), int((~rising & (back == 0)).sum())
    if late > LOST * len(kept):
        raise ValueError(f"{where}: {late} of {len(kept)} samples are out of order: sort them by time")
    lines += [f"{late} samples out of order by up to {back[row]:.2g} s"] if late else []
    return kept[rising], lines + ([f"{repeated} samples that repeat a time"] if repeated else [])


def wrapped(fall: float) -> str:
    """Describe the counter whose range is so many seconds; "" if there is none."""
    found = [name for name, seconds in WRAPS.items() if abs(fall / seconds - 1) < 0.02]
    return f"a counter of {found[0]} began anew" if found else ""


def longest_rise(t: Float[np.ndarray, " n"]) -> np.ndarray:
    """Find the indices of the longest non-decreasing sequence of times."""
    tops, at, before = [], [], np.full(len(t), -1)
    for i, time in enumerate(t.tolist()):
        place = bisect.bisect_right(tops, time)
        # A slice, because the place may be one beyond the end.
        tops[place : place + 1], at[place : place + 1] = [time], [i]
        before[i] = at[place - 1] if place else -1
    chain = [at[-1]]
    while before[chain[-1]] >= 0:
        chain.append(int(before[chain[-1]]))
    return np.array(chain[::-1])


def own_samples(t: Float[np.ndarray, " n"], values: Float[np.ndarray, "n k"], repeated: bool = True):
    """Recover the original samples of a signal that a program repeated or interpolated; else return the arguments.

    A program that joins signals of several rates repeats each slow value until the next, or interpolates linearly, so
    that lines meet at the samples, which may be between two times of its clock. A line over several intervals keeps a
    sample in each; one longer than `GAP` intervals becomes a gap unless the value is constant.
    """
    sound = np.isfinite(t).all() and np.isfinite(values).all() and (np.diff(t) > 0).all()
    if len(t) < FEWEST_OF_LINES or not sound:
        return t, values
    fresh = _fresh(values) if repeated else np.ones(len(t), bool)
    if not fresh.all():
        return t[fresh], values[fresh]
    slope = np.diff(values, axis=0) / np.diff(t)[:, None]
    bend = np.abs(np.diff(slope, axis=0)).max(axis=1) > STRAIGHT * np.abs(slope).max()
    moving = np.abs(slope[1:]).max(axis=1) > 0
    if not moving.any() or bend[moving].mean() > BENT or _in_steps(values):
        return t, values
    ends = [(t[0], values[0]), *_meetings(t, values, slope, bend), (t[-1], values[-1])]
    times, rows = map(np.array, zip(*ends, strict=True))
    lengths = np.diff(times) / np.median(np.diff(times))
    rests = (np.diff(rows, axis=0) == 0).all(axis=1)
    counts = np.where((lengths > GAP) & ~rests, 1, np.maximum(1, np.round(lengths))).astype(int)
    own = np.interp(np.arange(counts.sum() + 1), np.append(0, np.cumsum(counts)), times)
    return own, np.stack([np.interp(own, times, row) for row in rows.T], axis=1)


def _in_steps(values: Float[np.ndarray, "n k"]) -> bool:
    """Whether all values are multiples of a step, for example from a sensor or a file with few digits."""
    steps = np.abs(np.diff(values, axis=0))
    least = np.min(steps, axis=0, where=steps > 0, initial=np.inf)
    return bool(np.abs(steps / least - np.round(steps / least)).max() < WHOLE)


def _fresh(values: Float[np.ndarray, "n k"]) -> np.ndarray:
    """Whether each row is a new value, if values are repeated about equally often; otherwise all are."""
    new = np.append(True, (np.diff(values, axis=0) != 0).any(axis=1))
    counts = np.diff(np.flatnonzero(new))
    counts = counts[counts <= GAP * np.median(counts)] if len(counts) else counts
    if len(counts) < FEWEST_OF_LINES / 4 or counts.mean() < HELD:
        return np.ones(len(new), bool)
    regular = (np.abs(counts - counts.mean()) < 1).mean() >= REGULAR
    since = np.arange(len(new)) - np.flatnonzero(new)[np.cumsum(new) - 1]
    return new | (since % math.ceil(counts.mean()) == 0) if regular else np.ones(len(new), bool)


def _meetings(t, values, slope, bend):
    """Iterate over the samples at which lines meet: at a bend, or between two consecutive bends."""
    k = 1
    while k < len(t) - 1:
        late = 0.0
        if bend[k - 1] and k < len(t) - 2 and bend[k]:
            turn = slope[k - 1] - slope[k + 1]
            late = turn @ (slope[k] - slope[k + 1]) * (t[k + 1] - t[k]) / max(turn @ turn, 1e-300)
            late = late if 0 < late < t[k + 1] - t[k] else 0.0
        if bend[k - 1]:
            yield t[k] + late, values[k] + late * slope[k - 1]
        k += 2 if late else 1


def turned(parts: Mapping[str, Samples], world: str, body: str) -> dict[str, Samples]:
    """Rotate quantities from frames of `WORLDS` and `BODIES` to z up and forward-left-up."""
    turns = dict.fromkeys(("position", "velocity"), WORLDS[world].T)
    turns |= dict.fromkeys(("body_velocity", "rates", "specific_force"), BODIES[body].T)
    found = {name: part._replace(values=part.values @ turns[name]) for name, part in parts.items() if name in turns}
    if "attitude" in parts:
        part = parts["attitude"]
        found["attitude"] = part._replace(values=attitude(part.values, world, body))
    return {**parts, **found}


def attitude(q: Float[np.ndarray, "n 4"], world: str, body: str) -> Float[np.ndarray, "n 4"]:
    """Convert attitudes between other frames to the library's; invalid ones are unchanged."""
    with np.errstate(over="ignore"):
        sound = np.isfinite(q).all(axis=1) & (np.linalg.norm(q, axis=1) > 0)
    turned = np.array(q, float)
    if (world, body) != ("ENU", "FLU") and sound.any():
        matrices = WORLDS[world] @ rotation_of(q[sound]).as_matrix() @ BODIES[body].T
        # Keep the norm, so that a wrong one can still be detected.
        norms = np.linalg.norm(q[sound], axis=1, keepdims=True)
        turned[sound] = quaternion_from_matrix(matrices) * norms
    return turned
