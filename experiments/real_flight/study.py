"""Learn, adapt and test in every fold: rows of errors on held-out flights."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache, partial
from typing import Any

import numpy as np

from experiments.real_flight.config import RealFlightConfig
from experiments.reporting import names
from experiments.reporting.results import Results
from experiments.runner.cache import identity_of
from experiments.runner.stages import Found, Stages, rows_of
from hybrid_jax.adaptation import Adaptation, adapt
from hybrid_jax.cli.logs import Flights
from hybrid_jax.dynamics import AbstractVectorField, FrozenRates, HoldState, VehicleModel, rigid_body
from hybrid_jax.flights.checks.cleaning import lag_motors
from hybrid_jax.flights.log import FlightLog, segments
from hybrid_jax.flights.windows import cut_windows, flight_of, folds, manoeuvre_of
from hybrid_jax.identification.adaptation import adapted
from hybrid_jax.identification.learning import NAMES, STEPS, UNITS, Learned, errors_of, learn, rmse

LEARNED, ADAPTED = "learned", "adapted"
BASELINES = (names.HOLD, names.THRUST, names.LINEAR_RESIDUAL)
MODELS = (ADAPTED, LEARNED, names.SCRATCH, names.PHYSICS_ONLY, *reversed(BASELINES))
TAGS = ("flight", "model", "n_train", "seed")
GROUP_BY = {"flight": flight_of, "manoeuvre": manoeuvre_of}
LINEAR = 2000  # windows that a linear residual is fitted to


@dataclass(frozen=True)
class Fold:
    """Disjoint flights for training and testing; `name` lists the latter."""

    name: str
    train: list[FlightLog]
    test: list[FlightLog]


def make_folds(train: Sequence[FlightLog], tested: Sequence[FlightLog] | None, config: RealFlightConfig) -> list[Fold]:
    """Make the folds; without separate test flights, each training flight is held out once."""
    if tested is not None and (config.target is not None or config.folds_by == "flight"):
        return [Fold("test", list(train), list(tested))]
    of = GROUP_BY[config.folds_by]
    known = {of(log) for log in train} & {of(log) for log in tested or train}
    if len(known) < 2:
        none_left = "all flights are of one name, so none is left to train on; give flights to --test"
        raise ValueError(f"--folds-by {config.folds_by}: {none_left}")
    found = []
    for _, held_out in folds(
        [log for log in train if of(log) in known], min(config.folds, len(known)), of, config.data_seed
    ):
        held = sorted({of(log) for log in held_out})
        rest = [log for log in train if of(log) not in held]
        found.append(Fold(", ".join(held), rest, [log for log in tested or train if of(log) in held]))
    return found


def run_folds(
    config: RealFlightConfig, model: VehicleModel, sets: Mapping[str, Flights], stages: Stages
) -> tuple[list[Fold], Results]:
    """Return the folds, and a row of each model on each test flight."""
    adapts = "target" in sets
    tested = sets["test"].logs if "test" in sets else None
    made = make_folds(sets.get("target", sets["source"]).logs, tested, config)
    for fold in made:
        if not adapts and len(fold.train) < 2:
            raise ValueError(f"--before: without {fold.name} one flight is left; two at least, one for validation")
        for log in fold.test:
            if all(part.stop - part.start <= max(config.horizon) for part in segments(log)):
                raise ValueError(f"--horizon: no window of {max(config.horizon)} intervals without gaps in {log.name}")

    @cache
    def learned(number: int, seed: int) -> Learned:
        return learn(model, sets["source"].logs if adapts else made[number].train, seed)

    def job(number: int, seed: int) -> Found:
        source = learned(0 if adapts else number, seed)  # all folds share what was learned before a change
        return of_fold(config, model, made[number], source, seed, adapts)

    jobs = {
        f"fold {number} seed {seed}": partial(job, number, seed)
        for number in range(len(made))
        for seed in range(config.seeds)
    }
    contents = {name: sorted(each.contents.values()) for name, each in sets.items()}
    found = stages.kept(
        "real flight", jobs, identity_of(config.described(), contents, vars(model.vehicle), list(model.learn))
    )
    return made, Results(rows_of(found), TAGS)


def of_fold(
    config: RealFlightConfig, model: VehicleModel, fold: Fold, source: Learned, seed: int, adapts: bool
) -> Found:
    """Return rows of one fold and seed; baselines only in the first seed."""
    train, test = ([lag_motors(log, source.lag) for log in each] for each in (fold.train, fold.test))
    physics, rigid = model.physics(), rigid_body(model.vehicle, (), model.terms)
    rows = []

    def score(name: str, field: AbstractVectorField, found: Adaptation | None = None, n: int = 0) -> None:
        for log in test:
            curve = rmse(errors_of(field, log, max(config.horizon)))
            row: dict[str, Any] = {"flight": flight_of(log), "model": name, "n_train": n, "seed": seed}
            row |= {"fold": fold.name, "chosen": found.chosen if found else source.chosen if name == LEARNED else ""}
            row["scores"] = {str(h): dict(zip(UNITS, curve[h - 1].tolist(), strict=True)) for h in config.horizon}
            row |= expected_of(source.expected if name == LEARNED and not adapts else None, found, curve)
            row |= parameters_of(found or (source.physics if name == LEARNED else None))
            rows.append(row)

    if seed == 0:
        fitted = cut_windows(train, STEPS, STEPS, LINEAR)
        linear = adapt(rigid, fitted, method=names.LINEAR_RESIDUAL).field
        for name, field in zip(BASELINES, (HoldState(), FrozenRates(physics), linear), strict=True):
            score(name, field)
    score(names.PHYSICS_ONLY, source.physics.field)
    score(LEARNED, source.field)
    for n in config.n if adapts else ():
        score(ADAPTED, *adapted(source.field, train, source.windows, n), n)
        score(names.SCRATCH, *adapted(physics, train, None, n), n)
    return rows, {}


def expected_of(learned: np.ndarray | None, found: Adaptation | None, curve: np.ndarray) -> dict[str, Any]:
    """Return the expected error after a window, and whether the actual one is inside its 80 % interval."""
    if learned is not None:
        ends = {name: each.tolist() for name, each in zip(UNITS, learned.T, strict=True)}
    elif found is not None and found.expected:
        first = next(iter(found.expected.values()))
        ends = {name: list(first[own]) for name, own in zip(UNITS, NAMES, strict=True)}
    else:
        return {"expected": None, "inside": None}
    came = dict(zip(UNITS, curve[STEPS - 1], strict=True))
    inside = {name: bool(low <= came[name] <= high) for name, (_, low, high) in ends.items()}
    return {"expected": {name: value for name, (value, *_) in ends.items()}, "inside": inside}


def parameters_of(found: Adaptation | None) -> dict[str, Any]:
    if found is None:
        return {"theta": None, "theta_interval": None}
    theta = {name: one.value for name, one in found.parameters.items()}
    ends = {name: [one.low, one.high] for name, one in found.parameters.items()}
    return {"theta": theta, "theta_interval": ends if found.without_intervals is None else None}
