"""How much a designed flight narrows the intervals: python -m experiments.excitation --help"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Annotated, Any, Literal, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray
from rich.console import Console

from experiments.excitation import results
from experiments.excitation.results import DESIGNED, FLIGHTS, RANDOM, DesignEvidence, Flown, margins
from experiments.flying.changes import CHANGES
from experiments.paper.conditions import measure, sensor_noise
from experiments.reporting.claims import evaluate, verdict_table
from experiments.reporting.report import Report, rows_in
from experiments.reporting.results import Results, Row
from experiments.runner import command
from experiments.runner.options import Count, Named, NotNegative, Positive, Run, Several
from experiments.runner.stages import stages_of
from hybrid_jax import control
from hybrid_jax.control import Controller
from hybrid_jax.dynamics.disturbance import with_disturbance
from hybrid_jax.dynamics.rigid_body import nominal, rigid_body
from hybrid_jax.estimation import covariance_of, fit_least_squares, intervals
from hybrid_jax.planning import Excitation, FlightBounds, excitation
from hybrid_jax.planning.fisher_information import information_of
from hybrid_jax.sim import flight as random_flight
from hybrid_jax.sim.domain import SOURCE, Domain
from hybrid_jax.trajectories import Trajectories
from hybrid_jax.vehicle import IRIS

NAME = "excitation"
DT, STEPS = random_flight.DT, 10  # s, and samples of a window of 0.1 s
BLOCKS = 10  # clusters of the covariance: a second each, as windows of one flight are correlated
Parameter = Literal["Ix", "Iy", "k"]
CASES = {"nothing": SOURCE} | {domain.name: domain for domain in CHANGES}
if TYPE_CHECKING:
    Change = str
else:
    Change = Literal[tuple(CASES)]


@dataclass(frozen=True)
class ExcitationConfig(Run):
    """Design a flight, simulate it and others of equal length, and compare their intervals."""

    seconds: Positive = 10.0
    """Length of each flight [s]."""
    change: Change = "parameter_shift"
    """The change before the flight."""
    parameters: Annotated[Several[Parameter], Named(name="learn")] = get_args(Parameter)
    """Parameters to identify."""
    noise: NotNegative = 1.0
    """Sensor noise; 1 is typical."""
    bounds: Annotated[FlightBounds, Named(name="")] = field(default_factory=FlightBounds)
    """The box of the designed flight."""
    speed: Annotated[Positive, Named(name="figure-eight-speed")] = 3.5
    """Top speed of the figure-8 [m/s]."""
    bandwidth: Positive = 2.0
    """Highest frequency of the design [Hz]."""
    starts: Count = 4
    """Number of random series to start from."""
    steps: Annotated[Count, Named(name="iterations")] = 200
    """Iterations of the search."""

    def __post_init__(self):
        Run.__post_init__(self)
        if not self.noise:
            raise ValueError("--noise must be above 0: without noise there are no intervals to compare")
        if not 3 <= self.seconds <= random_flight.SECONDS:
            raise ValueError(f"--seconds must be from 3 to {random_flight.SECONDS:g}, got {self.seconds}")


PRESETS = {
    "paper": ExcitationConfig(),
    "quick": ExcitationConfig(preset="quick", seeds=5, starts=2, steps=100),
    "smoke": ExcitationConfig(preset="smoke", seeds=2, seconds=3.0, starts=1, steps=2, bandwidth=1.0),
}


def experiment(config: ExcitationConfig, console: Console) -> None:
    stages, domain = stages_of(config, console), CASES[config.change]
    design = stages.timed("design", partial(designed, config), "compiling and searching")
    flights = stages.timed("flights", lambda: flown(config, domain, design), "compiling and flying")
    jobs = [partial(fitted, config, domain, flights, name, seed) for name in FLIGHTS for seed in range(config.seeds)]
    rows = Results([row for found in stages.parts("fits", jobs) for row in found], ("flight", "parameter", "seed"))
    extra = {"design": results.described(design), "flown": margins(config.bounds, flights[DESIGNED, 0][0])}
    stages.publish(NAME, config, rows, report, **extra)


def report(record: Mapping[str, Any]) -> Report:
    rows, planned, flown = rows_in(record), record["design"]["margins"], record["flown"]
    verdicts = evaluate(results.CLAIMS, DesignEvidence(rows, flown))
    made = [verdict_table(verdicts, "Hypotheses"), *results.tables(rows), results.margin_table(planned, flown)]
    return Report(record, results.draw(rows), made, results.conclusion(rows), verdicts)


def designed(config: ExcitationConfig) -> Excitation:
    model = with_disturbance(rigid_body(IRIS, config.parameters))
    noise = sensor_noise(config.noise).tolist()
    search = {name: getattr(config, name) for name in ("seconds", "bandwidth", "starts", "steps")}
    given = {"noise": noise, "window": STEPS * DT, "dt": DT} | search
    return excitation(model, config.parameters, config.bounds, jax.random.key(0), **given)


def flown(config: ExcitationConfig, domain: Domain, design: Excitation) -> dict[tuple[str, int], Flown]:
    """Return flights by name and seed; the controller's flights are the same for every seed."""
    controller = Controller(IRIS)
    altitude = (config.bounds.low[2] + config.bounds.high[2]) / 2
    paths = {
        "hover": control.hover((0.0, 0.0, altitude)),
        "figure-8": control.figure_eight(config.speed, altitude=altitude),
        DESIGNED: design.reference,
    }
    references = jnp.stack([control.sample(path, controller, config.seconds) for path in paths.values()])
    found = jax.device_get(_fly(domain, controller, references))
    steps = round(config.seconds / DT)
    seeds = range(config.seeds)
    flights = {(name, seed): (found[0][i], found[1][i]) for i, name in enumerate(paths) for seed in seeds}
    drawn = random_flight.random_flights(domain, 2 * config.seeds, config.seconds, jax.random.key(1))
    sound = np.flatnonzero(~random_flight.gone_wrong(np.asarray(drawn.states)))
    if len(sound) < config.seeds:
        raise ValueError(f"--change {config.change}: {len(sound)} of {2 * config.seeds} random flights stay in bounds")
    for seed, i in zip(seeds, sound, strict=False):
        flights[RANDOM, seed] = np.asarray(drawn.states[i][: steps + 1]), np.asarray(drawn.inputs[i][:steps])
    return flights


@eqx.filter_jit
def _fly(domain: Domain, controller: Controller, references: Float[Array, "k n 13"]):
    truth, model = domain.quadrotor(), rigid_body(IRIS)

    def one(reference):
        def plant(x, u, t):
            return truth.step(x, u, t, controller.period)

        flight = control.fly(plant, model, reference, reference[0], controller, bandwidth=10.0)
        return flight.x, flight.u

    return jax.vmap(one)(references)


def fitted(
    config: ExcitationConfig, domain: Domain, flights: Mapping[tuple[str, int], Flown], name: str, seed: int
) -> list[Row]:
    states, inputs = flights[name, seed]
    key = jax.random.fold_in(jax.random.key(2 + seed), FLIGHTS.index(name))
    log = jnp.asarray(states, jnp.float32), jnp.asarray(inputs, jnp.float32)
    found = jax.device_get(_fit(config.parameters, sensor_noise(config.noise), *log, key))
    truth = nominal(domain.vehicle)
    return [
        {
            "flight": name, "parameter": parameter, "seed": seed, "draw": None,
            "half_width": 50 * math.log(high / low) if low > 0 and math.isfinite(high) else math.inf,
            "predicted": 100 * 1.96 * float(std),
            "error": 100 * float(value / truth[parameter] - 1),
            "inside": bool(low <= truth[parameter] <= high),
        }
        for parameter, (value, low, high, std) in found.items()
    ]  # fmt: skip


@eqx.filter_jit
def _fit(parameters: tuple[str, ...], noise: np.ndarray, states: Array, inputs: Array, key: PRNGKeyArray):
    log, n = measure(states, noise, key), len(inputs) // STEPS * STEPS
    windows = Trajectories(
        log[:n:STEPS], inputs[:n].reshape(-1, STEPS, inputs.shape[1]), log[1 : n + 1].reshape(-1, STEPS, 13), DT
    )
    scale = jnp.asarray(noise, jnp.float32)
    found = fit_least_squares(with_disturbance(rigid_body(IRIS, parameters)), windows, scale=scale)
    covariance = covariance_of(found.field, windows, scale=scale, cluster=len(windows) // BLOCKS)
    told = information_of(found.field, states, inputs, DT, STEPS, scale)
    stds = jnp.sqrt(jnp.diagonal(told.covariance(jnp.ones(len(covariance), bool))))
    every = intervals(found.field, covariance, degrees=BLOCKS - 1)
    return {name: (*every[name], stds[i]) for i, name in enumerate(every) if name in parameters}


ABOUT = "Design the flight that determines the parameters best, and compare it with hover, figure-8 and random flight."
main = partial(command.run, NAME, ABOUT, experiment, presets=PRESETS)

if __name__ == "__main__":
    main()
