"""Which flights teach, which stop the training and which judge it, and which windows a seed draws of them."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Int

from experiments.real_flight.config import RealFlightConfig
from experiments.real_flight.logs import Windows, count_windows, cut, long_enough
from experiments.real_flight.recipes import RECIPES
from hybrid_jax.flights.log import FlightLog
from hybrid_jax.flights.splits import contiguous, flight_of, folds, hold_out, manoeuvre_of
from hybrid_jax.trajectories import Trajectories

FOLDS, VALIDATION_SHARE = 3, 0.2
NAMES_OF: dict[str, Callable[[FlightLog], str]] = {"flight": flight_of, "manoeuvre": manoeuvre_of}


@dataclass(frozen=True)
class Fold:
    """Flights that have none in common.

    Attributes:
        name: of what is tested.
        train, validation, test: to learn from, to stop by and choose by, to judge by.
    """

    name: str
    train: list[FlightLog]
    validation: list[FlightLog]
    test: list[FlightLog]


@dataclass(frozen=True)
class Lessons:
    """What models learn from: windows, of which lanes draw their own, and windows that stop the training."""

    train: Windows
    validation: Trajectories


def folds_of(learned: Sequence[FlightLog], tested: Sequence[FlightLog] | None, config: RealFlightConfig) -> list[Fold]:
    """The folds of flights to learn from and flights to test on; where there are none of these, the first take turns.

    Raises:
        ValueError: too few flights, or names, for it.
    """
    if tested is not None and (config.target is not None or config.folds_by == "flight"):
        return [_fold("test", learned, tested, config)]
    of = NAMES_OF[config.folds_by]
    names = {of(log) for log in learned if tested is None or of(log) in {of(other) for other in tested}}
    if len(names) < 2:
        raise ValueError(
            f"--folds-by {config.folds_by}: all flights are of one name, nothing is left to learn from; "
            "give flights to --test"
        )
    count = min(FOLDS, len(names)) if config.folds is None else config.folds
    shared = [log for log in learned if of(log) in names]
    try:
        splits = folds(shared, count, of, config.data_seed)
    except ValueError as error:
        raise ValueError(f"--folds: {error}") from error
    return [_turn(out, learned, tested, of, config) for _, out in splits]


def _turn(out: Sequence[FlightLog], learned, tested, of, config: RealFlightConfig) -> Fold:
    held = sorted({of(log) for log in out})
    rest = [log for log in learned if of(log) not in held]
    return _fold(", ".join(held), rest, [log for log in tested or learned if of(log) in held], config)


def _fold(name: str, learned: Sequence[FlightLog], tested: Sequence[FlightLog], config: RealFlightConfig) -> Fold:
    return Fold(name, *hold_out_validation(learned, config), list(tested))


def hold_out_validation(logs: Sequence[FlightLog], config: RealFlightConfig) -> tuple[list[FlightLog], list[FlightLog]]:
    """Flights to learn from, and about a fifth, but one name at least, to stop by.

    Raises:
        ValueError: all are of one name.
    """
    of = NAMES_OF[config.validated_by]
    names = sorted({of(log) for log in logs})
    if len(names) < 2:
        raise ValueError(
            f"--validate-by {config.validated_by}: {len(logs)} flights of one name ({names[0]}) are too few to learn "
            "from and to stop by"
        )
    count = max(1, round(VALIDATION_SHARE * len(names)))
    dealt = np.random.default_rng(config.data_seed).permutation(np.array(names, object))
    return hold_out(logs, list(dealt[:count]), of)


def require_windows(folds: Sequence[Fold], school: Fold | None, config: RealFlightConfig) -> None:
    """Refuse flights that are too short for what is asked of them; to be asked before anything is trained.

    Args:
        school: the source's flights, where the folds' own are those to adapt to.

    Raises:
        ValueError: which flights have no window, or that a fold's have fewer than --n.
    """
    longest = max(RECIPES[name].window for name in config.tried)
    for fold in (*([school] if school else []), *folds):
        long_enough(fold.train, longest)
        long_enough(fold.validation, longest)
    for fold in folds:
        long_enough(fold.test, config.longest)
        if len(config.tried) > 1:
            long_enough(fold.validation, config.longest)
        if school:
            _require_size(max(config.n), count_windows(fold.train, longest))


def _require_size(size: int, count: int) -> None:
    if size > count:
        raise ValueError(f"--n {size}: the training flights have only {count} windows; give a smaller --n")


def lessons(fold: Fold, steps: int, stride: int, count: int) -> Lessons:
    """Windows of `steps` intervals: of the training flights every `stride` samples, `count` of the validation ones."""
    return Lessons(cut(fold.train, steps, stride), thinned(cut(fold.validation, steps).windows, count))


def thinned(windows: Trajectories, count: int) -> Trajectories:
    """`count` windows, evenly spaced; some twice where there are fewer, so that shapes, and programs, are shared."""
    return windows[np.linspace(0, len(windows) - 1, count).round().astype(int)]


def padded(windows: Trajectories, count: int) -> Trajectories:
    """The windows and, behind them, some again: no lane draws those, and folds of different size share a program."""
    return windows[np.arange(count) % len(windows)]


def drawn(sizes: Sequence[int], size: int, draw: str, seed: int) -> Int[np.ndarray, " size"]:
    """Which windows a seed learns from, of flights with so many windows each.

    Random: any of them; smaller sizes are the beginning of larger ones. Contiguous: a run of one flight, or where no
    flight is that long, whole flights and a run of another.

    Raises:
        ValueError: there are not as many.
    """
    _require_size(size, sum(sizes))
    if draw == "random":
        return np.random.default_rng(seed).permutation(sum(sizes))[:size]
    starts, left = np.cumsum([0, *sizes]), list(sizes)
    taken: list[np.ndarray] = []
    while size > max(left):
        whole = int(np.random.default_rng((seed, len(taken))).choice(np.flatnonzero(left)))
        taken.append(np.arange(starts[whole], starts[whole + 1]))
        size, left[whole] = size - left[whole], 0
    run = [_in_place(contiguous(left, size, seed), left, starts)] if size else []
    return np.concatenate([*taken, *run])


def _in_place(indices: np.ndarray, left: Sequence[int], starts: np.ndarray) -> np.ndarray:
    """Indices into the windows of the flights that are left → into those of all flights."""
    flight = np.searchsorted(np.cumsum(left), indices, side="right")
    return indices - np.concatenate([[0], np.cumsum(left)])[flight] + starts[flight]


def apart(indices: np.ndarray, sizes: Sequence[int], spacing: int) -> np.ndarray:
    """Those of some windows that are at least `spacing` apart, or of different flights: that share no sample."""
    flight = np.searchsorted(np.cumsum(sizes), np.sort(indices), side="right")
    kept: list[int] = []
    last = (-1, -spacing)
    for index, of in zip(np.sort(indices).tolist(), flight.tolist(), strict=True):
        if of != last[0] or index - last[1] >= spacing:
            kept.append(index)
            last = (of, index)
    return np.array(kept, int)
