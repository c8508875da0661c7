"""Assign flights to training, validation and test, and sample the windows of each run."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Int

from experiments.real_flight.config import RealFlightConfig
from experiments.real_flight.models import RECIPES
from hybrid_jax.flights.log import FlightLog
from hybrid_jax.flights.windows import count_windows, flight_of, folds, hold_out, manoeuvre_of, require_length
from hybrid_jax.trajectories import Trajectories

FOLDS, VALIDATION_SHARE = 3, 0.2
GROUP_BY = {"flight": flight_of, "manoeuvre": manoeuvre_of}


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


def hold_out_validation(logs: Sequence[FlightLog], config: RealFlightConfig) -> tuple[list[FlightLog], list[FlightLog]]:
    """Split flights into training and validation: a fifth of the names, but at least one, is for validation."""
    of = GROUP_BY[config.validated_by]
    names = sorted({of(log) for log in logs})
    if len(names) < 2:
        few = f"{len(logs)} flights of one name ({names[0]}) are too few for training and validation"
        raise ValueError(f"--validate-by {config.validated_by}: {few}")
    count = max(1, round(VALIDATION_SHARE * len(names)))
    dealt = np.random.default_rng(config.data_seed).permutation(np.array(names, object))
    return hold_out(logs, list(dealt[:count]), of)


def require_windows(folds: Sequence[Fold], source: Fold | None, config: RealFlightConfig) -> None:
    """Refuse, before anything is trained, flights that are too short; with a source, folds hold flights to adapt to."""
    longest = max(RECIPES[name].window for name in config.tried)
    for fold in filter(None, (source, *folds)):
        require_length(fold.train, longest)
        require_length(fold.validation, longest)
    for fold in folds:
        require_length(fold.test, config.longest)
        if len(config.tried) > 1:
            require_length(fold.validation, config.longest)
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
