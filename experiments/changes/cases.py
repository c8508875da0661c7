"""Cases of adaptation: a world, a change and a flight to adapt to; with a row for each source and flight."""

import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple, get_args

import jax
import tyro
from jaxtyping import PRNGKeyArray

import hybrid_jax as hj
from experiments.changes.measures import EXPECTED, error_of, expected_inside, parameters_of
from experiments.changes.methods import AUTO, METHODS, NOT_ADAPTED, Task
from experiments.paper.config import OneFlight, WorldName
from experiments.reporting.results import Row
from experiments.runner.cache import identity_of
from experiments.runner.options import Count, Several
from experiments.runner.stages import Found, Stages, rows_of
from experiments.worlds.flights import LEARNING, WORLDS, trained, usual_flights
from experiments.worlds.world import CHANGES, MADE_FOR, NOT_MADE_FOR, NOTHING, USUAL, World, logged
from hybrid_jax.io.datasets import Dataset
from hybrid_jax.sweep.lanes import lane

STEPS, LONG = 10, 100  # intervals of a window to learn from, and to test on
TESTING = 10.0  # s, of a flight
SOURCE, TARGET, TEST, NOISE, TRAINING, LOGGING = range(6)  # purposes of a key
MANY = 5  # flights to train on in the paper's protocol: 1000 windows
COMPARED = 6  # sources from which other methods adapt, too
FlightName = Literal["moving", "hover", "near_ground", "short", "noisy", "outliers"]
if TYPE_CHECKING:
    ChangeName = str
else:
    ChangeName = Literal[CHANGES]


class Manner(NamedTuple):
    """A flight to adapt to: one of `world.KINDS`, with noise relative to the usual and possibly a burst of outliers."""

    kind: str = "moving"
    seconds: float = 10.0
    noise: float = 1.0
    burst: bool = False


FLIGHTS: dict[str, Manner] = {
    USUAL: Manner(),
    "hover": Manner("hover"),
    "near_ground": Manner("near_ground"),
    "short": Manner(seconds=3.0),
    "noisy": Manner(noise=3.0),
    "outliers": Manner(burst=True),
}


@dataclass(frozen=True)
class HarmConfig(OneFlight):
    """Adapt to a usual flight after each change, and to other flights, for example a hover, after none."""

    changes: Several[ChangeName] = (*NOT_MADE_FOR, "reaction_torque", "external_force", "parameter_shift")
    """Which changes of the vehicle."""
    worlds: Several[WorldName] = ("iris", "hummingbird", "crazyflie")
    """Simulated vehicles. iris: our own simulator. hummingbird, crazyflie: vehicles of RotorPy."""
    learn_from: Several[FlightName] = get_args(FlightName)
    """Flights to adapt to. moving: ten seconds of usual flight. Of the others one draw for each source. near_ground:
    slow. short: three seconds. noisy: sensors three times as noisy. outliers: 0.3 s of outliers."""
    rotor_speeds: Literal["averaged", "sampled"] = "averaged"
    """How a log samples them: means over each interval, or values at its start."""
    n_test: Count = 20
    """Usual flights of ten seconds after each change, for each source."""
    # These have no effect here: each world has its own flights.
    sizes: Annotated[tuple[int, ...], tyro.conf.Suppress] = (100,)
    pool: Annotated[int | None, tyro.conf.Suppress] = None
    draw: Annotated[Literal["random", "contiguous"], tyro.conf.Suppress] = "contiguous"
    rivals: tuple[ChangeName, ...] = ("parameter_shift", "reaction_torque")
    """Changes after which other methods are compared with `hj.adapt`, on the first flight of six sources."""

    def cases(self) -> Iterator[tuple[ChangeName, FlightName]]:
        for change in self.changes:
            for flight in self.learn_from:
                if flight == USUAL or change == NOTHING:
                    yield change, flight


def key_of(world: World, config: HarmConfig, purpose: int, draw: int = 0) -> PRNGKeyArray:
    key = jax.random.fold_in(jax.random.key(config.data_seed), [*WORLDS].index(world.name))
    return jax.random.fold_in(jax.random.fold_in(key, purpose), draw)


def source_flights(world: World, config: HarmConfig, seed: int) -> Dataset:
    """Fly a source's training and validation flights: each seed has its own, as intervals concern their errors too."""
    numbers = {"train": config.source_train, "validation": config.validating()}
    each = round(LEARNING / STEPS * 100)
    flights = {name: -(-number // each) for name, number in numbers.items()}
    flown = usual_flights(world, NOTHING, sum(flights.values()), LEARNING, key_of(world, config, SOURCE, seed))
    noise = config.noise if config.noise_on == "all" else 0.0
    log = partial(logged, steps=STEPS, noise=noise, averaged=config.rotor_speeds == "averaged")
    windows, first = log(flown, key_of(world, config, LOGGING, seed)), each * flights["train"]
    splits = {"train": windows[: numbers["train"]], "validation": windows[first : first + numbers["validation"]]}
    return Dataset(splits, {"config": {"domain": world.name}})


def flown_after(world: World, change: str, flight: str, number: int, config: HarmConfig) -> hj.Trajectories:
    kind, seconds, noise, burst = FLIGHTS[flight]
    flown = world.fly(change, kind, 1, seconds, key_of(world, config, TARGET, number))
    key, averaged = key_of(world, config, NOISE, 1 + number), config.rotor_speeds == "averaged"
    return logged(flown, key, STEPS, noise=noise * config.noise, averaged=averaged, burst=burst)


class Tests(NamedTuple):
    """Usual flights after a change: all without noise, and each as logged."""

    exact: hj.Trajectories
    logged: list[hj.Trajectories]


def tests_after(world: World, change: str, config: HarmConfig, seed: int) -> Tests:
    key, averaged = key_of(world, config, TEST, seed), config.rotor_speeds == "averaged"
    flown = usual_flights(world, change, config.n_test, TESTING, key)
    noisy = logged(flown, key, LONG, noise=config.noise, averaged=averaged)
    each = len(noisy) // config.n_test
    others = [noisy[i : i + each] for i in range(0, len(noisy), each)]
    return Tests(logged(flown, key, LONG, noise=0.0, averaged=averaged), others)


def many_after(world: World, change: str, config: HarmConfig) -> tuple[hj.Trajectories, hj.Trajectories]:
    """Return windows of many flights for training, and others for early stopping, without noise."""
    flown = usual_flights(world, change, MANY + 1, LEARNING, key_of(world, config, TRAINING))
    averaged = config.rotor_speeds == "averaged"
    windows = logged(flown, key_of(world, config, NOISE), STEPS, noise=0.0, averaged=averaged)
    first = len(windows) * MANY // (MANY + 1)
    return windows[:first], windows[first:]


def adapted(world: World, config: HarmConfig, stages: Stages) -> list[Row]:
    """Return a world's rows: for each case, source, draw and method the change of the error on usual flights.

    Each source has flights of its own, to adapt to and to test on as well, so that sources are independent cases.
    """
    flown = [source_flights(world, config, seed) for seed in range(config.seeds)]
    one = replace(config, seeds=1)
    fields = [lane(trained(world, one, stages, own), 0) for own in flown]

    def of_case(change: str, flight: str) -> Found:
        compare, noise = flight == USUAL and change in config.rivals, FLIGHTS[flight].noise * config.noise
        many = many_after(world, change, config) if compare else None
        rows: list[dict[str, Any]] = []
        for seed, (field, own) in enumerate(zip(fields, flown, strict=True)):
            test = tests_after(world, change, config, seed)
            for draw in range(config.draws if flight == USUAL else 1):
                windows = flown_after(world, change, flight, seed * config.draws + draw, config)
                task = Task(world, field, own.splits["train"], windows, noise, many)
                tags: dict[str, Any] = {"world": world.name, "change": change, "flight": flight}
                tags |= {"draw": draw, "seed": seed}
                methods = (AUTO, NOT_ADAPTED) if change == NOTHING and flight == USUAL and draw == 0 else (AUTO,)
                methods = METHODS if compare and draw == 0 and seed < COMPARED else methods
                rows += [tags | row_of(name, task, change, test) for name in methods]
        # Errors on flights of another kind are not those to expect.
        return [row if flight == USUAL else row | dict.fromkeys(EXPECTED) for row in rows], {}

    jobs = {f"{change} {flight}": partial(of_case, change, flight) for change, flight in config.cases()}
    return rows_of(stages.kept(f"adapt {world.name}", jobs, identity_of(config.described(), *fields, *flown)))


def row_of(method: str, task: Task, change: str, test: Tests) -> dict[str, Any]:
    begun = time.process_time()
    model = METHODS[method](task)
    seconds = time.process_time() - begun
    before, after = (float(error_of(field, test.exact)) for field in (task.source, model.field))
    row: dict[str, Any] = {"method": method, "made_for": change in MADE_FOR, "seconds": seconds}
    row |= {"chosen": model.result.chosen if model.result else None}
    row |= {"source_mse": before, "test_mse": after, "ratio": after / before}
    inside = expected_inside(model.field, model.result.expected if model.result else {}, test.logged)
    return row | parameters_of(task.world, change, model.parameters) | inside
