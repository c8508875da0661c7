"""Which flights a model learns from and which judge it: a flight, or a manoeuvre, is never on both sides.

Windows of one flight overlap and share their wind, battery and payload, so windows drawn at random from all flights
would be judged by their own neighbours.
"""

import re
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Int

from hybrid_jax.flights.log import FlightLog

Split = tuple[list[FlightLog], list[FlightLog]]  # to learn from, and held out
SUFFIXES = (".csv", ".csv.gz", ".ulg")  # of files that are flights
_RUN = re.compile(r"[_\- ]*((run|flight|take|log)[_\- ]*|[_\- ])\d+$", re.IGNORECASE)


def flight_of(log: FlightLog) -> str:
    """The name of a flight's file, without folder and `SUFFIXES`."""
    name = Path(log.name).name
    suffix = next((each for each in SUFFIXES if name.lower().endswith(each)), "")
    return name[: len(name) - len(suffix)]


def manoeuvre_of(log: FlightLog) -> str:
    """The name of a flight without the number of its run: "chirp_run2" and "chirp-03" are a "chirp".

    A number is that of a run only behind a separator, or behind "run", "flight", "take" or "log": a "figure8" is none.
    """
    return _RUN.sub("", flight_of(log)) or flight_of(log)


def hold_out(logs: Sequence[FlightLog], names: Sequence[str], of: Callable[[FlightLog], str] = flight_of) -> Split:
    """The flights of other names, and those of these names.

    Raises:
        ValueError: a name that no flight has, or none left on one side.
    """
    known = sorted({of(log) for log in logs})
    for name in names:
        if name not in known:
            raise ValueError(f"names: no flight is called {name!r}, only {', '.join(known)}")
    split = [log for log in logs if of(log) not in names], [log for log in logs if of(log) in names]
    if not all(split):
        raise ValueError(
            f"names: {len(split[0])} flights to learn from and {len(split[1])} held out; each side needs one"
        )
    return split


def folds(
    logs: Sequence[FlightLog], count: int | None = None, of: Callable[[FlightLog], str] = flight_of, seed: int = 0
) -> list[Split]:
    """Splits in which each flight is held out once, all of one name together.

    Args:
        count: how many splits; by default one for each name.
        of: what must not be on both sides: `flight_of`, `manoeuvre_of` or one's own.
        seed: of the order in which names are dealt out.

    Raises:
        ValueError: fewer than two splits, or more than there are names.
    """
    names = sorted({of(log) for log in logs})
    count = len(names) if count is None else count
    if not 2 <= count <= len(names):
        raise ValueError(f"count must be from 2 to the {len(names)} different names of the flights, got {count}")
    dealt = np.random.default_rng(seed).permutation(np.array(names, object))
    return [hold_out(logs, list(dealt[i::count]), of) for i in range(count)]


def contiguous(sizes: Sequence[int], count: int, seed: int) -> Int[np.ndarray, " count"]:
    """Indices of `count` windows in a row, all of one flight: how little flight is needed shows in these.

    Args:
        sizes: how many windows each flight has, in order; their windows follow each other, as in `concatenate`.

    Raises:
        ValueError: no flight has as many windows.
    """
    places = [max(0, size - count + 1) for size in sizes]
    if count < 1 or not any(places):
        raise ValueError(
            f"count must be from 1 to the {max(sizes, default=0)} windows of the longest flight, got {count}"
        )
    at = int(np.random.default_rng(seed).integers(sum(places)))
    flight = int(np.searchsorted(np.cumsum(places), at, side="right"))
    begin = sum(sizes[:flight]) + at - sum(places[:flight])
    return np.arange(begin, begin + count)
