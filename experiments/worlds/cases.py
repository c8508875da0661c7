"""Cases of adaptation: a world, a change and a flight to adapt to; from these to a row for each source and flight."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Literal, NamedTuple, get_args

import jax
from jaxtyping import PRNGKeyArray

import hybrid_jax as hj
from experiments.paper.config import OneFlight
from experiments.paper.study import EVERY, pretrained
from experiments.reporting.names import HYBRID
from experiments.reporting.results import Row
from experiments.runner.cache import identity_of
from experiments.runner.options import distinct
from experiments.runner.stages import Found, Stages, rows_of
from experiments.worlds.iris import Iris
from experiments.worlds.rotorpy import ROTORPY
from experiments.worlds.world import CHANGES, MADE_FOR, NOTHING, World, logged
from hybrid_jax.io.datasets import Dataset
from hybrid_jax.metrics import rollout_mse
from hybrid_jax.runtime import FAST_COMPILE, jit_with
from hybrid_jax.sweep.lanes import lane

WORLDS: dict[str, World] = {world.name: world for world in (Iris(), *ROTORPY)}
STEPS, LONG = 10, 100  # intervals of a window to learn from, and to test on
LEARNING, TESTING = 20.0, 10.0  # s, of a flight
SOURCE, TARGET, TEST, NOISE = range(4)  # purposes of a key
WorldName = Literal["iris", "hummingbird", "crazyflie"]
FlightName = Literal["moving", "hover", "near_ground", "short", "noisy", "outliers"]
if TYPE_CHECKING:
    ChangeName = str
else:
    ChangeName = Literal[CHANGES]


class Flight(NamedTuple):
    """A flight to adapt to.

    Attributes:
        kind: one of `world.KINDS`.
        seconds: its length [s].
        noise: of its sensors, over that of other flights.
        burst: whether some of its samples are wild.
    """

    kind: str = "moving"
    seconds: float = 10.0
    noise: float = 1.0
    burst: bool = False


USUAL: FlightName = "moving"
FLIGHTS: dict[str, Flight] = {
    USUAL: Flight(),
    "hover": Flight("hover"),
    "near_ground": Flight("near_ground"),
    "short": Flight(seconds=3.0),
    "noisy": Flight(noise=3.0),
    "outliers": Flight(burst=True),
}


@dataclass(frozen=True)
class WorldsConfig(OneFlight):
    """Adapt to one flight in several worlds: after each change a usual one; each other flight, after no change."""

    worlds: tuple[WorldName, ...] = ("iris", "hummingbird", "crazyflie")
    """True systems. iris: the simulator of the other experiments. hummingbird, crazyflie: vehicles of RotorPy."""
    changes: tuple[ChangeName, ...] = CHANGES
    """Which changes of the vehicle."""
    learn_from: tuple[FlightName, ...] = get_args(FlightName)
    """Flights to adapt to. moving: ten seconds of usual flight. near_ground: slow. short: three seconds. noisy: sensors
    three times as noisy. outliers: 0.3 s of wild samples."""
    rotor_speeds: Literal["averaged", "sampled"] = "averaged"
    """How a log has them: as means over each interval, or sampled at its start."""
    test_flights: int = 6
    """Usual flights of ten seconds after each change, without noise."""

    def __post_init__(self):
        OneFlight.__post_init__(self)
        distinct("--worlds", self.worlds)
        distinct("--learn-from", self.learn_from)

    def cases(self) -> Iterator[tuple[ChangeName, FlightName]]:
        """A change and a flight to adapt to."""
        for change in self.changes:
            for flight in self.learn_from:
                if flight == USUAL or change == NOTHING:
                    yield change, flight


def key_of(world: World, config: WorldsConfig, purpose: int, draw: int = 0) -> PRNGKeyArray:
    """For everything random of this purpose."""
    key = jax.random.fold_in(jax.random.key(config.data_seed), [*WORLDS].index(world.name))
    return jax.random.fold_in(jax.random.fold_in(key, purpose), draw)


def source_flights(world: World, config: WorldsConfig) -> Dataset:
    """The windows to train sources on, and others to stop by."""
    numbers = {"train": config.source_train, "validation": config.validating()}
    each = round(LEARNING / STEPS * 100)
    flights = {name: -(-number // each) for name, number in numbers.items()}
    flown = world.fly(NOTHING, USUAL, sum(flights.values()), LEARNING, key_of(world, config, SOURCE))
    noise = config.noise if config.noise_on == "all" else 0.0
    log = partial(logged, steps=STEPS, noise=noise, averaged=config.rotor_speeds == "averaged")
    windows, first = log(flown, key_of(world, config, NOISE)), each * flights["train"]
    splits = {"train": windows[: numbers["train"]], "validation": windows[first : first + numbers["validation"]]}
    return Dataset(splits, {"config": {"domain": world.name}})


def flown_after(world: World, change: str, flight: str, draw: int, config: WorldsConfig) -> hj.Trajectories:
    """The windows to adapt to, of one flight."""
    kind, seconds, noise, burst = FLIGHTS[flight]
    flown = world.fly(change, kind, 1, seconds, key_of(world, config, TARGET, draw))
    key, averaged = key_of(world, config, NOISE, 1 + draw), config.rotor_speeds == "averaged"
    return logged(flown, key, STEPS, noise=noise * config.noise, averaged=averaged, burst=burst)


def tests_after(world: World, change: str, config: WorldsConfig) -> hj.Trajectories:
    """Usual flights after a change, without noise."""
    flown = world.fly(change, USUAL, config.test_flights, TESTING, key_of(world, config, TEST))
    return logged(flown, key_of(world, config, TEST), LONG, noise=0.0, averaged=config.rotor_speeds == "averaged")


@jit_with(FAST_COMPILE)
def error_of(field: hj.AbstractVectorField, test: hj.Trajectories):
    """L^T_MSE, at every 0.1 s of a second."""
    return rollout_mse(field, test, EVERY)


def adapted(world: World, config: WorldsConfig, stages: Stages) -> list[Row]:
    """The rows of a world: for each case, draw and source what `hj.adapt` does to its error on usual flights."""
    source = source_flights(world, config)
    fields = pretrained(HYBRID, world.vehicle, config, stages, source).fields

    def of_case(change: str, flight: str) -> Found:
        test = tests_after(world, change, config)
        rows = []
        for draw in range(config.draws):
            windows = flown_after(world, change, flight, draw, config)
            for seed in range(config.seeds):
                field = lane(fields, seed)
                result = hj.adapt(field, windows, learned_from=source.splits["train"])
                before, after = (float(error_of(each, test)) for each in (field, result.field))
                tags = {"world": world.name, "change": change, "flight": flight, "draw": draw, "seed": seed}
                known = {"made_for": change in MADE_FOR, "chosen": result.chosen, "source_mse": before}
                rows.append(tags | known | {"test_mse": after, "ratio": after / before})
        return rows, {}

    jobs = {f"{change} {flight}": partial(of_case, change, flight) for change, flight in config.cases()}
    return rows_of(stages.kept(f"adapt {world.name}", jobs, identity_of(config.described(), fields, source)))
