"""Which flights, and which of their windows, train, stop, choose and test."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Int

from experiments.real_flight.config import RealFlightConfig
from experiments.real_flight.models import RECIPES
from hybrid_jax.dynamics.rigid_body import RIGID_BODY_SPACE
from hybrid_jax.extrapolation import Features
from hybrid_jax.flights.log import FlightLog
from hybrid_jax.flights.windows import count_windows, flight_of, folds, hold_out, manoeuvre_of, require_length
from hybrid_jax.trajectories import Trajectories

FOLDS, VALIDATION_SHARE = 3, 0.2
LEFT_OUT = 5  # most parts of a fold's flights that are left out of training in turn, which bounds the cost
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


def motion_of_logs(logs: Sequence[FlightLog]) -> Features:
    """Features of every sample of some logs."""
    x, u = (np.concatenate([getattr(log, name) for log in logs]) for name in "xu")
    return RIGID_BODY_SPACE.features(x, u)
