"""Split flights into training and test by flight or by manoeuvre.

Windows of one flight overlap and share wind, battery and payload, so a split of windows would leak into the test.
"""

import re
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from hybrid_jax.flights.log import FlightLog

Split = tuple[list[FlightLog], list[FlightLog]]  # training, held out
SUFFIXES = (".csv", ".csv.gz", ".ulg")  # of log files
_SUFFIX = re.compile(r"(\.csv|\.csv\.gz|\.ulg)$", re.IGNORECASE)
_RUN = re.compile(r"[_\- ]*((run|flight|take|log)[_\- ]*|[_\- ])\d+$", re.IGNORECASE)


def flight_of(log: FlightLog) -> str:
    """The name of a flight's file, without folder and `SUFFIXES`."""
    return _SUFFIX.sub("", Path(log.name).name)


def manoeuvre_of(log: FlightLog) -> str:
    """The name of a flight without the number of its run: "chirp_run2" and "chirp-03" are both "chirp".

    A number counts as that of a run after a separator or after "run", "flight", "take" or "log"; "figure8" has none.
    """
    return _RUN.sub("", flight_of(log)) or flight_of(log)


def hold_out(logs: Sequence[FlightLog], names: Sequence[str], of: Callable[[FlightLog], str] = flight_of) -> Split:
    """Split flights into those of other names and those of the given names.

    Raises:
        ValueError: an unknown name, or one side is empty.
    """
    known = sorted({of(log) for log in logs})
    for name in names:
        if name not in known:
            raise ValueError(f"names: no flight is called {name!r}, only {', '.join(known)}")
    split = [log for log in logs if of(log) not in names], [log for log in logs if of(log) in names]
    if not all(split):
        found = f"{len(split[0])} flights for training and {len(split[1])} held out"
        raise ValueError(f"names: {found}; each side needs one")
    return split


def folds(
    logs: Sequence[FlightLog], count: int | None = None, of: Callable[[FlightLog], str] = flight_of, seed: int = 0
) -> list[Split]:
    """Make splits in which each flight is held out once, together with all flights of its name.

    Args:
        count: number of splits; by default one per name.
        of: the name of a flight: `flight_of`, `manoeuvre_of` or a function of your own.

    Raises:
        ValueError: count is less than 2 or more than the number of names.
    """
    names = sorted({of(log) for log in logs})
    count = len(names) if count is None else count
    if not 2 <= count <= len(names):
        raise ValueError(f"count must be from 2 to the {len(names)} different names of the flights, got {count}")
    dealt = np.random.default_rng(seed).permutation(np.array(names, object))
    return [hold_out(logs, list(dealt[i::count]), of) for i in range(count)]
