"""Samples as they stand in a log, in ticks of its clock, and how they become the signals of a `Recording`."""

import contextlib
import gzip
import zlib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import IO, NamedTuple

import numpy as np
from jaxtyping import Float

from hybrid_jax.flights.attitude import BODIES, WORLDS, quaternion_from_matrix, rotation_of
from hybrid_jax.flights.log import wrong_norms
from hybrid_jax.flights.recording import GAP, Recording, Signal

GZIP = b"\x1f\x8b"
XYZ, WXYZ, BATTERY = ("x", "y", "z"), ("w", "x", "y", "z"), ("battery",)
LATE = 0.1  # s; a time that is further behind is a restarted clock, not a sample that came late
WRAPS = (16, 32)  # bits of counters that may begin anew
FEWEST_OF_LINES = 100  # samples; of fewer, lines may be chance
STRAIGHT = 1e-6  # of the steepest slope: by how much that of a line may change at a sample, by rounding
BENT = 0.5  # share of samples with a bend from which on a signal was not made of lines
OPTIONAL = ("voltage",)  # samples that are not finite are left out, not refused


class Samples(NamedTuple):
    """n samples of one quantity at integer or real ticks, with its axes and where it came from, for messages."""

    ticks: np.ndarray
    values: Float[np.ndarray, "n k"]
    axes: tuple[str, ...]
    source: str


def is_packed(path: str | Path) -> bool:
    """Whether a file is gzip, by its first bytes."""
    with Path(path).open("rb") as file:
        return file.read(2) == GZIP


def opened(path: str | Path) -> IO[bytes]:
    """A file, plain or gzip, to read its bytes."""
    return gzip.open(path) if is_packed(path) else Path(path).open("rb")  # pyright: ignore[reportReturnType]


@contextlib.contextmanager
def readable(path: str | Path) -> Iterator[IO[bytes]]:
    """A file, plain or gzip, to read; ValueError, with the file and what to do, if that cannot be done."""
    try:
        with opened(path) as file:
            yield file
    except FileNotFoundError as error:
        raise ValueError(f"{path}: no such file") from error
    except (EOFError, zlib.error) as error:
        raise ValueError(f"{path}: the gzip data are truncated or damaged; copy the file again") from error
    except OSError as error:
        raise ValueError(f"{path}: cannot be read: {error.strerror or error}") from error


def unpacked(path: str | Path) -> bytes:
    """The bytes of a file, plain or gzip; errors as of `readable`."""
    with readable(path) as file:
        return file.read()


def record(
    path: str | Path,
    parts: Mapping[str, Samples],
    tick: float = 1.0,
    notes: Sequence[str] = (),
    facts: Mapping[str, str] | None = None,
) -> Recording:
    """The recording of a file whose clock counts ticks of so many seconds, by quantity; empty parts are left out.

    Repeated time stamps, and samples up to `LATE` out of order, are left out with a note.

    Raises:
        ValueError: file, source, time and what was expected, in one line.
    """
    parts = {name: part for name, part in parts.items() if len(part.ticks)}
    if not parts:
        raise ValueError(f"{path}: holds no quantity of a flight; see docs/howto/logs.md for what to log")
    start = min(part.ticks[0] for part in parts.values())
    signals, said = {}, list(notes)
    for name, part in parts.items():
        where = f"{path}: {part.source}"
        t = (part.ticks - start).astype(float) * tick
        for row in np.flatnonzero(~np.isfinite(t))[:1]:
            raise ValueError(f"{where}: the time of sample {row} is {t[row]}, must be finite")
        kept, left_out = _in_order(where, t, tick)
        finite = np.isfinite(part.values).all(axis=1)
        if name in OPTIONAL and not finite.all():
            lost = t[~finite]
            left_out.append(f"{name} is no number in {len(lost)} samples, the first at {lost[0]:.4g} s")
            kept &= finite
        said += [f"{part.source}: {line}: left out" for line in left_out]
        if name == "attitude":
            for row, norm in wrong_norms(part.values[kept]):
                raise ValueError(f"{where}: the quaternion at {t[kept][row]:.6g} s has norm {norm:.4g}, must be 1")
        try:
            signals |= {name: Signal(t[kept], part.values[kept], part.axes, part.source)} if kept.any() else {}
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from error
    return Recording(str(path), signals, tuple(dict.fromkeys(said)), facts or {})


def _in_order(where: str, t: Float[np.ndarray, " n"], tick: float) -> tuple[np.ndarray, list[str]]:
    """Which samples come after all before them, and what is to be said of the others."""
    latest = np.maximum.accumulate(t)
    kept = np.append(True, t[1:] > latest[:-1])
    back = latest - t
    row = int(back.argmax())
    steps = np.diff(t)
    usual = float(np.median(steps[steps > 0])) if (steps > 0).any() else 0.0
    ticks = (usual - steps.min(initial=0.0)) / tick  # by which a counter fell
    wrapped = [bits for bits in WRAPS if abs(ticks / 2**bits - 1) < 0.02]
    if wrapped or back[row] > max(LATE, GAP * usual):
        why = f"a counter of {wrapped[0]} bits began anew" if wrapped else "the clock was set back or a log appended"
        advice = "split the file there"
        raise ValueError(f"{where}: time goes back from {latest[row]:.6g} s to {t[row]:.6g} s: {why}; {advice}")
    late, repeated = int((back > 0).sum()), int((~kept & (back == 0)).sum())
    lines = [f"{late} samples out of order by up to {back[row]:.2g} s"] if late else []
    return kept, lines + ([f"{repeated} samples that repeat a time"] if repeated else [])


def uninterpolated(t: Float[np.ndarray, " n"], values: Float[np.ndarray, "n k"]):
    """Times and values of the samples between which a program drew straight lines, or the arguments as they are.

    A program that puts signals of several rates on one clock writes a slow one as lines with bends at its samples. A
    sample that fell between two times of that clock is where the lines beside it meet. A line as long as several
    intervals keeps a sample in each; one longer than `GAP` intervals becomes a gap, which may lie under it.
    """
    sound = np.isfinite(t).all() and np.isfinite(values).all() and (np.diff(t) > 0).all()
    if len(t) < FEWEST_OF_LINES or not sound:
        return t, values
    slope = np.diff(values, axis=0) / np.diff(t)[:, None]
    bend = np.abs(np.diff(slope, axis=0)).max(axis=1) > STRAIGHT * np.abs(slope).max()
    moving = np.abs(slope[1:]).max(axis=1) > 0
    if not moving.any() or bend[moving].mean() > BENT:
        return t, values
    ends = [(t[0], values[0]), *_meetings(t, values, slope, bend), (t[-1], values[-1])]
    times, rows = map(np.array, zip(*ends, strict=True))
    lengths = np.diff(times) / np.median(np.diff(times))
    counts = np.where(lengths > GAP, 1, np.maximum(1, np.round(lengths))).astype(int)
    own = np.interp(np.arange(counts.sum() + 1), np.append(0, np.cumsum(counts)), times)
    return own, np.stack([np.interp(own, times, row) for row in rows.T], axis=1)


def _meetings(t, values, slope, bend):
    """Time and value of each sample in which lines meet: at a bend, or between two bends that follow each other."""
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


def world(values: Float[np.ndarray, "n 3"], frame: str) -> Float[np.ndarray, "n 3"]:
    """Vectors of a world of `WORLDS` in the library's, z up."""
    return values @ WORLDS[frame].T


def body(values: Float[np.ndarray, "n 3"], frame: str) -> Float[np.ndarray, "n 3"]:
    """Vectors of a body of `BODIES` in the library's, forward-left-up."""
    return values @ BODIES[frame].T


def attitude(q: Float[np.ndarray, "n 4"], world: str, body: str) -> Float[np.ndarray, "n 4"]:
    """Attitudes between other frames as attitudes between the library's; those of no rotation stay as they are."""
    sound = np.isfinite(q).all(axis=1) & (np.linalg.norm(q, axis=1) > 0)
    turned = np.array(q, float)
    if sound.any():
        matrices = WORLDS[world] @ rotation_of(q[sound]).as_matrix() @ BODIES[body].T
        # Not of length 1: a wrong norm must still be seen.
        norms = np.linalg.norm(q[sound], axis=1, keepdims=True)
        turned[sound] = quaternion_from_matrix(matrices) * norms
    return turned
