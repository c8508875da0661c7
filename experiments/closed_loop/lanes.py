"""Every closed-loop flight as a lane of one compiled program, flown block by block; finished blocks are kept."""

import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from rich.console import Console

from experiments.closed_loop.common_field import Believed
from experiments.closed_loop.lane_groups import LaneGroups
from experiments.closed_loop.rows import FlightRow, Flyer
from experiments.runner.progress import clock
from hybrid_jax.control import Controller, figure_eight, fly, hover, low_pass, performance, sample, step, upset
from hybrid_jax.control.promises import excess, least_promise, promises
from hybrid_jax.control.references import Path as Reference
from hybrid_jax.io.archive import Arrays, digest, load_archive, named_leaves, save_archive
from hybrid_jax.io.datasets import versions
from hybrid_jax.io.files import backup_path
from hybrid_jax.io.models import describe
from hybrid_jax.sim.domain import EXTERNAL_FORCE, Domain
from hybrid_jax.sim.forces import Parameters, Wrench
from hybrid_jax.sim.quadrotor import Quadrotor
from hybrid_jax.state import POSITION, STATE_SIZE
from hybrid_jax.sweep import hosts
from hybrid_jax.sweep.lanes import LaneMap, count

FORMAT = "hybrid_jax closed loop 1"
RECIPE = 6  # raise it when the same lanes no longer fly the same
MADE_BY = ("jax", "hybrid_jax")
FORCES = EXTERNAL_FORCE.forces  # all that act in any domain
WIDTH = {"cpu": 4}  # lanes side by side; see docs/control.md
CALL_EVERY = 50  # calls from one whose promise is compared to the next
DRAW_EVERY = 5  # states from one that is kept for figures to the next
ALTITUDE = 1.5  # m

Scalar = Float[Array, ""]


def crossing(t: Scalar) -> tuple[Float[Array, "3"], Scalar]:
    """A low pass over home, which a flight of 10 s crosses after 5."""
    place, yaw = low_pass(speed=2.0)(t)
    return place - jnp.array([10.0, 0.0, 0.0]), yaw


PATHS: Mapping[str, Reference] = {
    "hover": hover((0.0, 0.0, ALTITUDE)),
    "figure_eight": figure_eight(3.5, altitude=ALTITUDE),
    "fast_figure_eight": figure_eight(6.0, altitude=ALTITUDE),
    "step": step((1.0, 1.0, 0.5), yaw=np.pi / 2, altitude=ALTITUDE),
    "low_pass": crossing,
    "upset": hover((0.0, 0.0, ALTITUDE)),
}


class Lane(eqx.Module):
    """One flight.

    Attributes:
        model: what the controller believes in.
        vehicle: the true one.
        shares: of each of FORCES: 1 where it acts.
        path: which of PATHS.
        home: where that takes place [m, world].
        bandwidth: of the disturbance observer [rad/s]; 0 for none.
    """

    model: Believed
    vehicle: Parameters
    shares: Float[Array, " f"]
    path: Int[Array, ""]
    home: Float[Array, "3"]
    bandwidth: Scalar


@dataclass(frozen=True)
class Block:
    """Flights of one domain along one of PATHS.

    Attributes:
        distance: from home [m], equally far in x and y.
        flyers: who flies: a lane for each seed.
    """

    domain: Domain
    reference: str
    distance: float
    flyers: Mapping[Flyer, Believed]

    @property
    def name(self) -> str:
        """For people, and for the file."""
        away = f" {self.distance:g} m away" if self.distance else ""
        return f"{self.domain.name} {self.reference}{away}"

    def keys(self) -> list[tuple[Flyer, int]]:
        """Who flies each lane, and its seed."""
        return [(flyer, seed) for flyer, field in self.flyers.items() for seed in range(count(field))]

    def lanes(self, bandwidth: float) -> list[Lane]:
        """Those of each flyer, stacked; bandwidth of the observers [rad/s]."""
        return [self._lanes(field, bandwidth * flyer.observer) for flyer, field in self.flyers.items()]

    def _lanes(self, field: Believed, bandwidth: float) -> Lane:
        def repeated(value):
            return jax.tree.map(lambda leaf: np.repeat(np.asarray(leaf)[None], count(field), axis=0), value)

        return Lane(
            model=field,
            vehicle=repeated(self.domain.parameters()),
            shares=repeated(np.array([force in self.domain.forces for force in FORCES], np.float32)),
            path=repeated(np.int32(list(PATHS).index(self.reference))),
            home=repeated(np.array([self.distance, self.distance, 0.0], np.float32) / np.float32(np.sqrt(2))),
            bandwidth=repeated(np.float32(bandwidth)),
        )


@dataclass(frozen=True)
class Flights:
    """What is kept of a block.

    Attributes:
        arrays: name of each quantity → its values, a lane first; see `simulate`.
        seconds: that it took.
        processor_seconds: on all cores.
        devices: that flew.
    """

    block: Block
    arrays: Arrays
    seconds: float
    processor_seconds: float
    devices: int

    def rows(self) -> list[FlightRow]:
        """A row for each flight, in the order of the block's flyers."""
        return [self._row(i, *key) for i, key in enumerate(self.block.keys())]

    def states(self, flyer: Flyer, seed: int = 0) -> np.ndarray:
        """The states of one flight, every 0.05 s from the start on."""
        return self.arrays["states"][self.block.keys().index((flyer, seed))]

    def _row(self, i: int, flyer: Flyer, seed: int) -> FlightRow:
        numbers = ("position_rmse", "yaw_rmse", "largest_error", "saturation", "excess")
        found = {name: float(self.arrays[name][i]) for name in numbers}
        costs = {name: float(self.arrays[name][i].mean()) for name in ("promised", "realised")}
        place = {"domain": self.block.domain.name, "reference": self.block.reference, "distance": self.block.distance}
        crashed = bool(self.arrays["crashed"][i])
        known: dict[str, Any] = {**place, **asdict(flyer), **found, **costs}
        return FlightRow(seed=seed, crashed=crashed, **known)


class Airspace:
    """Flies blocks with one controller, all lanes of all of them by one compiled program.

    Args:
        seconds: length of a flight.
        bandwidth: of the disturbance observers [rad/s].
        blocks: that will be flown.
        folder: where finished blocks are kept.
        fresh: move aside what other versions have flown, and fly it anew.
    """

    def __init__(
        self,
        controller: Controller,
        seconds: float,
        bandwidth: float,
        blocks: Sequence[Block],
        folder: Path,
        console: Console,
        fresh: bool = False,
    ):
        self._controller, self._bandwidth = controller, bandwidth
        self._folder, self._console, self._fresh = folder, console, fresh
        references = np.stack([np.asarray(sample(path, controller, seconds)) for path in PATHS.values()])
        starts = references[:, 0].copy()
        thrown = list(PATHS).index("upset")
        starts[thrown] = upset(jnp.asarray(references[thrown, 0]))
        self._shared = (references, starts)
        even = -(-max(len(block.keys()) for block in blocks) // jax.device_count())
        width = WIDTH.get(jax.default_backend(), even)
        self._groups = LaneGroups([block.lanes(bandwidth) for block in blocks], width)
        self._run = LaneMap(self._groups.mapped(partial(simulate, controller)), 1, min_capacity=self._groups.room)

    def fly(self, block: Block) -> Flights:
        """The flights of a block, found in the cache or flown now.

        Raises:
            ValueError: what is kept of the block is damaged; names the file.
        """
        lanes = block.lanes(self._bandwidth)
        path = self._folder / f"{block.name.replace(' ', '-')}-{self._identity(lanes)[:16]}.npz"
        about, arrays = hosts.from_first(lambda: self._found(path))
        words = "as found in the cache"
        if about is None:
            about, arrays = self._flown(lanes)
            words = clock(about["seconds"])
            if hosts.is_main_process():
                save_archive(path, FORMAT, about, arrays)
        self._console.print(f"{block.name}: {len(block.keys())} flights, {words}", highlight=False, soft_wrap=True)
        return Flights(block, arrays, about["seconds"], about["processor_seconds"], about["devices"])

    def _identity(self, lanes: list[Lane]) -> str:
        fixed = [RECIPE, CALL_EVERY, DRAW_EVERY, asdict(self._controller), *(describe(each.model) for each in lanes)]
        return digest(fixed, named_leaves({"lanes": lanes, "shared": self._shared}))

    def _found(self, path: Path):
        if not path.exists():
            return None, {}
        about, arrays = load_archive(path, FORMAT)
        if self._fresh and about["versions"] != versions(*MADE_BY):
            self._console.print(
                f"{path}: moved aside to {path.rename(backup_path(path, 'before')).name}", highlight=False
            )
            return None, {}
        return about, arrays

    def _flown(self, lanes: list[Lane]):
        groups, where = self._groups.grouped(lanes)
        costs = self._groups.costs(groups)
        self._run(groups, self._shared, costs, [])  # compiles, flies nothing
        began, worked = time.perf_counter(), time.process_time()
        found = self._run(groups, self._shared, costs, range(len(costs)))
        spent = {"seconds": time.perf_counter() - began, "processor_seconds": time.process_time() - worked}
        arrays = {name: array[where[:, 0], where[:, 1]] for name, array in found.items()}
        return {**spent, "devices": jax.device_count(), "versions": versions(*MADE_BY)}, arrays


def simulate(
    controller: Controller, lane: Lane, references: Float[Array, "k n 13"], starts: Float[Array, "k 13"]
) -> dict[str, Array]:
    """Fly one lane: what `performance` says of it, `promised`, `realised` and `excess` of some calls, and `states`."""
    offset = jnp.zeros(STATE_SIZE).at[POSITION].set(lane.home)
    reference, x0 = references[lane.path] + offset, starts[lane.path] + offset
    truth = Quadrotor(lane.vehicle, (_acting(lane.shares),))

    def plant(x, u, t):
        return truth.step(x, u, t, controller.period)

    flight = fly(plant, lane.model, reference, x0, controller, lane.bandwidth)
    calls = range(CALL_EVERY, len(flight.u), CALL_EVERY)
    costs = promises(plant, flight, reference, controller, calls)
    return {
        **vars(performance(flight, reference, controller)),
        **costs._asdict(),
        "excess": excess(costs, least_promise(controller)),
        "states": flight.x[::DRAW_EVERY],
    }


def _acting(shares: Float[Array, " f"]):
    """The sum of FORCES, each times its share."""

    def acting(x, u, t, parameters) -> Wrench:
        wrenches = [force(x, u, t, parameters) for force in FORCES]
        return Wrench(*(jnp.tensordot(shares, jnp.stack(parts), 1) for parts in zip(*wrenches, strict=True)))

    return acting
