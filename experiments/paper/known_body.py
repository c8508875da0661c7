"""How often the intervals of θ_p contain the truth where the vehicle is a known rigid body and no network is fitted."""

import itertools
from dataclasses import dataclass, field
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PRNGKeyArray
from rich.console import Console

from experiments.paper.conditions import Noise, measure
from experiments.reporting.results import Results
from experiments.reporting.tables import Table, tabulate
from experiments.runner.options import Count, CountFromZero, NotNegative, check_numbers
from experiments.runner.progress import Line
from hybrid_jax import rotation
from hybrid_jax.dynamics.base import AbstractVectorField
from hybrid_jax.dynamics.rigid_body import LEARNED, RigidBody, nominal, rigid_body
from hybrid_jax.estimation.least_squares import fit_least_squares
from hybrid_jax.estimation.uncertainty import Kind, covariance_of, intervals
from hybrid_jax.integrate import rollout_batch
from hybrid_jax.runtime import FASTEST_COMPILE, jit_with
from hybrid_jax.state import VELOCITY
from hybrid_jax.trajectories import Trajectories
from hybrid_jax.vehicle import IRIS

DT = 0.01  # s
PART = 10  # repeats, at the least, between two looks at the clock
TRUTH = {"Ix": 0.04, "Iy": 0.02, "k": IRIS.thrust_coefficient}  # SI: the paper's parameter shift
NoiseOn = Literal["targets", "all"]


@dataclass(frozen=True)
class Flight:
    """How the windows are flown: a vehicle near hover that leans into its velocity; standard deviations."""

    speed: NotNegative = 2.0
    """[m/s], along each axis, a third of it vertically."""
    tilt: NotNegative = 0.1
    """[rad], about each axis, in addition to the lean that balances the drag in steady flight."""
    body_rates: NotNegative = 1.0
    """[rad/s], along each axis."""
    rotor_speed: NotNegative = 40.0
    """[rad/s], of each rotor about hover, drawn anew in each interval."""


@dataclass(frozen=True)
class KnownBody:
    """Fly known rigid bodies, add noise, fit θ_p by least squares, count how often its interval contains the truth.

    Twice: a truth that is the model itself, and one with linear drag that the model does not know. The first says
    whether the intervals are honest, the second how far they mislead when the physics is wrong.
    """

    repeats: Count = 100
    """Independent recordings, each with its own fit."""
    n_train: int = 100
    """Windows in a recording."""
    steps: Count = 10
    """Intervals of 0.01 s in a window."""
    level: float = 0.95
    """Of the intervals: what the coverage should be."""
    kind: Kind = "sandwich"
    """sandwich: windows are independent, nothing else is assumed. homoscedastic: all errors white and of one size,
    which those of a vehicle's sensors are not."""
    noise_on: tuple[NoiseOn, ...] = ("targets", "all")
    """targets: the start of each window is known exactly, as the fit takes it to be. all: it is measured as well."""
    noise: Noise = field(default_factory=Noise)
    flight: Flight = Flight()
    drag: NotNegative = 0.4
    """[kg/s] of the truth that the model does not know: v̇ −= drag v / m."""
    seed: CountFromZero = 0
    """Everything random follows from it; the same flights and noise in every case."""
    batch: Count = 1
    """Repeats that are computed side by side: one on a CPU, many on a GPU."""


class Dragged(AbstractVectorField):
    """A rigid body with linear drag: v̇ −= c v / m."""

    body: RigidBody
    drag: Float[Array, ""]  # kg/s

    def __call__(self, x, u):
        return self.body(x, u).at[VELOCITY].add(-self.drag / self.body.vehicle.mass * x[VELOCITY])


def coverage(config: KnownBody, console: Console) -> Results:
    """A row for each parameter in every case: exact physics and unknown drag, with noise on what was asked for.

    Shares; bias and half-width in % of the truth. A repeat that did not converge is a miss.
    """
    if config.n_train <= len(LEARNED):
        raise ValueError(f"--known.n-train must be more than the {len(LEARNED)} parameters, got {config.n_train}")
    if not 0 < config.level < 1:
        raise ValueError(f"--known.level must be between 0 and 1, got {config.level}")
    if not config.noise_on or len(set(config.noise_on)) < len(config.noise_on):
        raise ValueError(f"--known.noise-on must be targets, all or both, got {' '.join(config.noise_on) or 'nothing'}")
    check_numbers("--known.", config)
    drags = {"exact physics": 0.0, "unknown drag": config.drag}
    cases = list(itertools.product(drags, config.noise_on))
    parts, done, rows = _parts(config), itertools.count(1), []
    with Line("coverage, known body", console) as line:
        for case, noise_on in cases:
            pieces = []
            for keys in parts:
                pieces.append(
                    jax.device_get(_repeats(config, jnp.array(noise_on == "all"), jnp.asarray(drags[case]), keys))
                )
                line.show_parts(next(done), len(cases) * len(parts))
            repeats = jax.tree.map(lambda *pieces: np.concatenate(pieces)[: config.repeats], *pieces)
            share = repeats["inside"].mean(axis=0)
            columns = {
                "coverage": share,
                "standard_error": np.sqrt(share * (1 - share) / config.repeats),
                "bias": 100 * repeats["error"].mean(axis=0),
                "half_width": 100 * repeats["half_width"].mean(axis=0),
                "converged": np.full(len(LEARNED), repeats["converged"].mean()),
            }
            rows += [
                {"case": case, "noise_on": noise_on, "parameter": parameter}
                | {name: float(column[i]) for name, column in columns.items()}
                for i, parameter in enumerate(LEARNED)
            ]
    return Results(rows, ("case", "noise_on", "parameter"))


def recording(
    config: KnownBody, start_is_measured: Bool[Array, ""], drag: Float[Array, ""], key: PRNGKeyArray
) -> Trajectories:
    """Windows of the true vehicle as they would be measured."""
    start_key, input_key, x0_key, x_key = jax.random.split(key, 4)
    x0 = starts(config, start_key)
    jitter = jax.random.normal(input_key, (config.n_train, config.steps, 4))
    u = IRIS.hover_speed + config.flight.rotor_speed * jitter
    truth = RigidBody({name: jnp.log(TRUTH[name] / value) for name, value in nominal(IRIS).items()}, IRIS)
    x = rollout_batch(Dragged(truth, drag), x0, u, DT)
    start = jnp.where(start_is_measured, measure(x0, config.noise, x0_key), x0)
    return Trajectories(start, u, measure(x, config.noise, x_key), DT)


def starts(config: KnownBody, key: PRNGKeyArray) -> Float[Array, "n 13"]:
    """Random states near hover.

    In steady flight a vehicle leans into its velocity until thrust balances drag, by c v / (m g) [rad] horizontally.
    Without this link between attitude and velocity the drag that the model does not know would be as often up as down
    the thrust, and would average out.
    """
    flight = config.flight
    velocity_key, tilt_key, rates_key = jax.random.split(key, 3)
    v = flight.speed * jax.random.normal(velocity_key, (config.n_train, 3)) * jnp.array([1.0, 1.0, 1 / 3])
    lean = config.drag / (IRIS.mass * IRIS.gravity) * jnp.stack([-v[:, 1], v[:, 0]], axis=1)
    half = (lean + flight.tilt * jax.random.normal(tilt_key, lean.shape)) / 2
    q = rotation.normalise(jnp.pad(half, ((0, 0), (1, 1)), constant_values=((0, 0), (1.0, 0.0))))
    omega = flight.body_rates * jax.random.normal(rates_key, v.shape)
    return jnp.concatenate([jnp.zeros_like(v), q, v, omega], axis=1)


def _parts(config: KnownBody) -> list[PRNGKeyArray]:
    """The keys of all repeats, a few at a time: between two parts progress is drawn and interrupts are handled."""
    size = min(config.batch * -(-PART // config.batch), config.repeats)
    keys = jax.random.split(jax.random.key(config.seed), config.repeats)
    # The last part is filled up, so that one program serves all.
    return [keys[np.arange(begin, begin + size) % config.repeats] for begin in range(0, config.repeats, size)]


@jit_with(FASTEST_COMPILE)
def _repeats(
    config: KnownBody, start_is_measured: Bool[Array, ""], drag: Float[Array, ""], keys: PRNGKeyArray
) -> dict[str, Array]:
    """A part of the repeats, stacked, errors in shares of the truth: one program for all parts and cases."""

    def one(key: PRNGKeyArray) -> dict[str, Array]:
        windows = recording(config, start_is_measured, drag, key)
        found = fit_least_squares(rigid_body(IRIS), windows)
        around = intervals(found.field, covariance_of(found.field, windows, kind=config.kind), config.level)
        value, low, high = (jnp.stack(side) for side in zip(*(around[name] for name in LEARNED), strict=True))
        true = jnp.array([TRUTH[name] for name in LEARNED])
        inside = (low <= true) & (true <= high) & found.converged
        errors = {"error": value / true - 1, "half_width": (high - low) / (2 * true)}
        return errors | {"inside": inside, "converged": found.converged}

    return jax.lax.map(one, keys, batch_size=min(config.batch, len(keys)))


def known_body_table(rows: Results, level: float) -> Table:
    """A line for each parameter in every case of `coverage`."""
    columns = {
        "coverage [%]": lambda r: f"{100 * r[0]['coverage']:.1f} ± {100 * r[0]['standard_error']:.1f}",
        "bias [%]": lambda r: f"{r[0]['bias']:+.2f}",
        "half-width [%]": lambda r: f"{r[0]['half_width']:.2f}",
        "converged [%]": lambda r: f"{100 * r[0]['converged']:.0f}",
    }
    title = f"A known rigid body: does the {100 * level:g} % interval contain the truth?"
    return tabulate(title, rows.group("case", "noise_on", "parameter"), columns, ("truth", "noise on", "θ_p"))
