"""Minutes of hover in two worlds, then a side wind: is adapting in the air ever worse than not adapting?"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from itertools import permutations, product
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float
from rich.console import Console
from rich.progress import track

from experiments.flying.plant import World
from experiments.flying.scenario import hardware
from experiments.online.worlds import body_of, plant_of, truth_of
from experiments.reporting.tables import Table, print_table
from experiments.runner import command
from experiments.worlds.rotorpy import Constants, advance, decide
from experiments.worlds.world import DT, NOTHING, Reference
from hybrid_jax import control
from hybrid_jax.dynamics import AbstractVectorField, rigid_body, with_disturbance
from hybrid_jax.online import Hypothesis, OnlineAdaptation
from hybrid_jax.runtime import FASTEST_COMPILE, configure, jit_with
from hybrid_jax.sim import pilot
from hybrid_jax.sim.forces import parameters_of
from hybrid_jax.vehicle import BODY_RATES, IRIS, POSITION, VELOCITY, State

HOVER, PATH, BLOCK = control.hover((0.0, 0.0, 2.0)), control.figure_eight(2.0, 1.5, 2.0), 10  # periods of a prediction
CHANGE = np.array([0.0, -8 / 3, 0.0])  # m/s²: the side wind at the end
MEMORY, AFTER = 1.0, 30  # s, of a gust; blocks after the change
RIGHT = np.arange(4)[None]  # the order of rotors in what the filter is given
SOUND = RIGHT, np.ones((1, 3))  # with a factor of each rate
EXCHANGED = np.array([order for order in permutations(range(4)) if sum(np.array(order) != range(4)) == 2])
SENSORS = np.concatenate([1 - 2 * np.eye(3), np.full((1, 3), np.degrees(1))])  # wrong signs, and degrees
FAULTS = np.concatenate([np.tile(RIGHT, (4, 1)), EXCHANGED, RIGHT]), np.concatenate([SENSORS, np.ones((7, 3))])
GUSTS = 0.0, 1.0  # m/s², rms in each direction
ERRORS = "error of v, ω over the first model's"
HOVERED = ("gusts", ERRORS, "v from 1 s after a wind", "its error is halved after [s]", "alarm after [s]")
HOVERED += ("largest change of Ix, Iy, k [%]", "their intervals hold [%]", "inconsistent [%]")
ENDED = "wrong sign of p, q, r, degrees, exchanges, no fault: ended after [s]", f"largest {ERRORS} from then on"
PRIOR = {"Ix": 0.3, "Iy": 0.3, "k": 0.2}
DISTURBANCE, PROCESS = (3.0,) * 3 + (5.0,) * 3, (0.0,) * 7 + (0.003,) * 3 + (0.005,) * 3
PUSHES = tuple(f"disturbance[v{axis}]" for axis in "xyz")
HYPOTHESES = (
    Hypothesis("inertia", {"Ix": 0.3, "Iy": 0.3}),
    Hypothesis("thrust", {"k": 0.2}),
    Hypothesis("wind", dict.fromkeys(PUSHES, 3.0), rates=dict.fromkeys(PUSHES, 1.5), lead=0.1),
)


def _iris(truth: World, integral, x: State, seen: State, push: Float[Array, "3"], goal: tuple[Array, Array]):
    """Decide, and simulate a period in a push alone, without drag and ground effect: they are not in the model."""
    course = pilot.Course(*goal, jnp.zeros(()), jnp.zeros(4))
    integral, u = pilot.act(integral, seen, course, parameters_of(IRIS), IRIS, pilot.scale_of(IRIS))
    x = plant_of(truth._replace(shares=0 * truth.shares), u, 0.0)(x, u, jnp.zeros(()))
    return integral, x.at[VELOCITY].add(DT * push).at[POSITION].add(DT**2 / 2 * push), u


def _hummingbird(truth: Constants, speeds, x: State, seen: State, push: Float[Array, "3"], goal: tuple[Array, Array]):
    """Decide, and simulate a period in a wind with about the same effect."""
    aim = Reference(*goal, jnp.zeros(3), jnp.zeros(()), jnp.zeros(()))
    command = jnp.clip(decide(truth, seen, aim), 0.0, truth.fastest)
    (x, speeds), mean = advance(truth._replace(wind=1.5 * push), x, speeds, command, jnp.zeros(()))
    return speeds, x, mean


SPINNING = body_of("hummingbird").vehicle.hover_speed * np.ones(4, np.float32)
PILOTS = {"iris": (_iris, np.zeros(3, np.float32)), "hummingbird": (_hummingbird, SPINNING)}


class Hovered(NamedTuple):
    """The record of a flight at the end of each block of 0.1 s: squared errors of the adapted and the first model."""

    errors: Float[Any, "*n t 2 2"]
    theta: Float[Any, "*n t p"]
    deviation: Float[Any, "*n t p"]
    inconsistent: Float[Any, "*n t"]
    exchanged: Float[Any, "*n t 4"]
    reversed: Float[Any, "*n t d"]
    changes: Float[Any, "*n t"]

    def ratios(self, first: int, last: int) -> Float[Any, "*n 2"]:
        """RMS error of the adapted model over the first one's in these blocks, of v and of ω."""
        rms = np.sqrt(self.errors[..., first:last, :, :].mean(axis=-3))
        return rms[..., 0, :] / rms[..., 1, :]

    def found(self, blocks: int) -> Float[Any, " *n"]:
        """Time after the wind until the adapted model errs half as much in v as the first one [s]; inf if never."""
        later = self.errors[..., blocks + 1 :, :, 0]
        return _first(later[..., 0] < later[..., 1] / 4)


def _first(found: Bool[np.ndarray, "*n t"]) -> Float[Any, " *n"]:
    """Time until the first block of which it is true [s]; inf if there is none."""
    return np.where(found.any(axis=-1), DT * BLOCK * (np.argmax(found, axis=-1) + 1), np.inf)


def adaptation_of(world: str, noise: float, named: bool = False) -> OnlineAdaptation:
    """Return the filter of docs/howto/online.md, or one with hypotheses."""
    sizes = tuple(hardware(noise, 0, 0).sizes().tolist())
    options: Any = {"process": PROCESS, "hypotheses": HYPOTHESES if named else ()}
    return OnlineAdaptation(rigid_body(body_of(world).vehicle), DT, sizes, PRIOR, DISTURBANCE, **options)


@jit_with(FASTEST_COMPILE)
def hover(
    adaptation: OnlineAdaptation, world: str, noise: float, blocks: int, gusts, keys, faults=SOUND, path=HOVER
) -> Hovered:
    """Fly for some blocks and AFTER more in a side wind, for each rms of gusts [m/s²], key and fault."""
    (step, start), device, kept = PILOTS[world], hardware(noise, 0, 0), np.exp(-DT / MEMORY)
    with jax.ensure_compile_time_eval():
        truth = truth_of(world, NOTHING, 0.0)
    first, sizes = with_disturbance(adaptation.field), np.square(device.sizes())

    def error(model: AbstractVectorField, before: State, after: State, inputs) -> Float[Array, "2"]:
        expected = jax.lax.scan(lambda x, u: (control.advance(model, x, u, DT), None), before, inputs)[0]
        squares = jnp.square(after - expected) + sizes
        return jnp.stack([jnp.sum(squares[VELOCITY]), jnp.sum(squares[BODY_RATES])])

    def goal(t):
        return jax.jvp(lambda t: path(t)[0], (t,), (jnp.ones(()),))

    def flight(gust, key, fault):
        def period(now, given):
            (own, x, seen, push, state), (key, steady, t) = now, given
            one, two = jax.random.split(key)
            push = kept * push + gust * np.sqrt(1 - kept**2) * jax.random.normal(one, (3,))
            own, x, u = step(truth, own, x, seen, push + steady * CHANGE, goal(t))
            seen = device.measure(x, two)
            state = adaptation.update(state, seen.at[BODY_RATES].multiply(fault[1]), u[fault[0]])
            return (own, x, seen, push, state), u

        def block(now, given):
            key, steady, times = given
            after, inputs = jax.lax.scan(period, now, (jax.random.split(key, BLOCK), jnp.full(BLOCK, steady), times))
            models, state = (adaptation.model(now[4]), first), after[4]
            errors = jnp.stack([error(model, now[1], after[1], inputs) for model in models])
            (theta, covariance), flags = adaptation.estimate(state), adaptation.flags(state)
            deviation = jnp.sqrt(jnp.diagonal(covariance))
            wrong = flags.inconsistent, flags.exchanged, flags.reversed
            return after, Hovered(errors, theta, deviation, *wrong, state.changes)

        (place, speed), times = goal(jnp.zeros(())), DT * jnp.arange((blocks + AFTER) * BLOCK).reshape(-1, BLOCK)
        x = jnp.zeros(13).at[POSITION].set(place).at[3].set(1.0).at[VELOCITY].set(speed)
        now = start, x, x, jnp.zeros(3), adaptation.begin(x)
        steady = jnp.where(jnp.arange(blocks + AFTER) < blocks, 0.0, 1.0)
        return jax.lax.scan(block, now, (jax.random.split(key, blocks + AFTER), steady, times))[1]

    return jax.vmap(flight)(gusts, keys, [jnp.broadcast_to(each, (len(keys), each.shape[1])) for each in faults])


@dataclass(frozen=True)
class Options:
    """Is adapting in the air ever worse than not adapting? Minutes of hover in two worlds, then a side wind."""

    seconds: float = 600.0
    """Length of the hover [s]."""


def run(options: Options) -> None:
    configure()
    console, blocks, path = Console(width=160), round(options.seconds / DT / BLOCK), 150
    own = blocks, jnp.array(GUSTS), jax.random.split(jax.random.key(7))
    print_table(console, table("Hover, then a side wind", HOVERED, hovered, *own))
    own = path, jnp.zeros(11), jax.random.split(jax.random.key(77), 11), FAULTS, PATH
    print_table(console, table("Faults on a path of 3 m", ENDED, ended, *own))


def table(title: str, columns: tuple[str, ...], cells: Callable, blocks: int, *given: Any) -> Table:
    """Fly with each filter, noise and world; `cells` returns lines of cells for some flights and a number of blocks."""
    lines = []
    for name, noise, world in track([*product(("all", "hypotheses"), (0.1, 1.0), PILOTS)], title):
        found = hover(adaptation_of(world, noise, name != "all"), world, noise, blocks, *given)
        own = cells(Hovered(*map(np.asarray, found)), blocks)
        lines += [(name, f"{noise:g}", world, *line) for line in own]
    return Table(title, ("filter", "noise", "world", *columns), lines, labels=3)


def hovered(both: Hovered, blocks: int) -> Iterator[tuple[str, ...]]:
    for i, gust in enumerate(GUSTS):
        own = Hovered(*(leaf[i] for leaf in both))
        (v, omega), late = own.ratios(10, blocks), own.ratios(blocks + 10, blocks + AFTER)[0]
        alarm = _first(own.changes[blocks:] > own.changes[blocks - 1])
        moved = " ".join(f"{100 * part:.1f}" for part in np.abs(own.theta[:blocks, :3]).max(axis=0))
        inside = (np.abs(own.theta) < 1.96 * own.deviation)[10:blocks, :3].mean()
        numbers = f"{v:.2f} {omega:.2f}", f"{late:.2f}", f"{own.found(blocks):.1f}", f"{alarm:.1f}", moved
        yield f"{gust:g}", *numbers, f"{100 * inside:.0f}", f"{100 * own.inconsistent[:blocks].mean():.0f}"


def ended(found: Hovered, blocks: int) -> Iterator[tuple[str, ...]]:
    stopped = (found.inconsistent | found.exchanged.any(axis=-1))[:, :blocks]
    ends = _first(np.logical_and.accumulate(stopped[:, ::-1], axis=1)[:, ::-1])
    late = [found.ratios(round(10 * end), blocks)[i] for i, end in enumerate(ends) if end < DT * BLOCK * blocks]
    v, omega = np.max(late, axis=0)
    yield " ".join(map("{:.1f}".format, ends)), f"{v:.2f} {omega:.2f}"


main = partial(command.call, "online.hover", Options, run)

if __name__ == "__main__":
    main()
