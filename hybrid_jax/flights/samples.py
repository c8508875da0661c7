"""Samples as they stand in a log, in ticks of its clock, and how they become the signals of a `Recording`."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from hybrid_jax.flights.attitude import BODIES, WORLDS, quaternion_from_matrix, rotation_of
from hybrid_jax.flights.log import wrong_norms
from hybrid_jax.flights.recording import GAP, Recording, Signal

XYZ, WXYZ, BATTERY = ("x", "y", "z"), ("w", "x", "y", "z"), ("battery",)
LATE = 0.1  # s; a time that is further behind is a restarted clock, not a sample that came late
WRAPS = (16, 32)  # bits of counters that may begin anew
OPTIONAL = ("voltage",)  # samples that are not finite are left out, not refused


class Samples(NamedTuple):
    """n samples of one quantity at integer or real ticks, with its axes and where it came from, for messages."""

    ticks: np.ndarray
    values: Float[np.ndarray, "n k"]
    axes: tuple[str, ...]
    source: str


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
