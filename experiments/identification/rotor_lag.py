"""The lag of rotors, from samples of their speeds: python -m experiments.identification.rotor_lag --help"""

from dataclasses import dataclass
from functools import partial
from itertools import product
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from rich.console import Console

import hybrid_jax as hj
from experiments.reporting.tables import Table, print_table
from experiments.runner import command
from experiments.runner.options import Count, CountFromZero, Positive, Several
from experiments.worlds.flights import PHYSICS, WORLDS, usual_flights
from experiments.worlds.world import DT, Flown, logged
from hybrid_jax import metrics
from hybrid_jax.dynamics import SampledRotors
from hybrid_jax.dynamics.rigid_body import RIGID_BODY_SPACE
from hybrid_jax.networks import zero_output
from hybrid_jax.training import Settings
from hybrid_jax.training.objective import scaled_loss
from hybrid_jax.vehicle import STATE_SIZE

LAGS = {5: "nothing", 30: "motor_lag"}  # ms, of the vehicle before and after this change
GUESS, PRIOR = 0.012, {"parts": 1.0}  # s; the lag is known within a factor of e, or the search may lose it at zero
LONG, SHORT, OTHERS = 25, 10, 3  # intervals of windows for physics and network; flights that choose the epoch, and test
HUMMINGBIRD = WORLDS["hummingbird"]
AT_REST = (0.0,) * 3 + (1.0,) + (0.0,) * 9


@dataclass(frozen=True)
class Options:
    """Learn the lag of rotors with inertias, thrust and drag, from one sample of their speeds every 10 ms.

    RotorPy's Hummingbird flies with a lag of 5 and of 30 ms. Physics is fitted to noisy logs with unknown initial
    states, then a network is added. Errors on other flights are compared with those of a model that was learned from
    averaged speeds.
    """

    flights: Count = 10
    """Number of flights to learn from; three others choose the epoch of the network and test."""
    seconds: Positive = 20.0
    """Duration of each flight."""
    lags: Several[Literal[5, 30]] = (5, 30)
    """Time constants of the rotors [ms]."""
    kinds: Several[Literal["moving", "lively"]] = ("moving", "lively")
    """moving: sines of 0.15 to 0.8 Hz. lively: 1 to 2 Hz."""
    data_seed: CountFromZero = 0
    """Seed of the flights and of their noise."""


def learned(physics: hj.AbstractVectorField, flown: Flown, prior, key, options: Options):
    """Return the fit of physics, and the errors of physics and hybrid over 0.1 s of other flights without noise."""
    parts = np.split(np.arange(len(flown.states)), np.cumsum([options.flights, 1]))
    split, keys = [Flown(*(each[part] for each in flown)) for part in parts], jax.random.split(key, len(parts))
    model = hj.StateSpaceModel(physics, ("speeds",), start=AT_REST, spread=(np.inf,) * 12)
    levels = 1.0, 1.0, 0.0
    windows = [logged(one, own, SHORT, noise=n) for one, own, n in zip(split, keys, levels, strict=True)]
    fitted = hj.fit_records(model, records(logged(split[0], keys[0], LONG)), dt=DT, prior=prior)
    field = fitted.model.field
    network = hj.residual_network(STATE_SIZE, windows[0].u.shape[-1], jax.random.key(1), norm="none")
    hybrid = hj.Hybrid(field, zero_output(network))
    rates, settings = hj.rates_by_group(hybrid, {"residual": 1e-3}), Settings(objective=scaled_loss(field, windows[0]))
    result = hj.fit(hybrid, windows[0], windows[1], key, rates=rates, settings=settings, max_epochs=300)
    return fitted, [float(metrics.rollout_mse(each, windows[2])) for each in (field, result.best)]


def records(windows: hj.Trajectories) -> list[hj.Record]:
    x = np.concatenate([windows.x0[:, None], windows.x], axis=1)
    t = DT * np.arange(x.shape[1])
    states: list[Any] = [{one.name: (t, own[:, place]) for place, one in RIGID_BODY_SPACE.parts} for own in x]
    return [hj.Record.of("window", speeds=(t[:-1], u), **own) for u, own in zip(windows.u, states, strict=True)]


def line(lag: int, kind: str, options: Options) -> list[str]:
    key = jax.random.fold_in(jax.random.key(options.data_seed), lag)
    flown = usual_flights(HUMMINGBIRD, LAGS[lag], options.flights + OTHERS, options.seconds, key, kind)
    body, speeds = hj.rigid_body(HUMMINGBIRD.vehicle, PHYSICS), flown.sampled
    pairs = np.concatenate([speeds[:, :-1], speeds[:, 1:]], axis=-1)
    lagging = hj.with_hidden(body, SampledRotors(jnp.log(jnp.array(GUESS)), DT))
    (fit, errors), (_, known) = (
        learned(physics, Flown(flown.states[:, :-1], u, u), prior, key, options)
        for physics, u, prior in ((lagging, pairs, PRIOR), (body, flown.averaged[:, :-1], {}))
    )
    found = fit.intervals["parts.0.log_time_constant"]
    low, lag_found, high = (1e3 * np.exp(float(end)) for end in (found.low, found.value, found.high))
    inertias = (100 * np.expm1(fit.intervals[f"field.deviations.{axis}"].value) for axis in ("Ix", "Iy"))
    cells = f"{lag_found:.3g} ({low:.3g} … {high:.3g})", *(f"{error:+.2f}" for error in inertias)
    return [f"{lag}", kind, *cells, *(f"{own / other:.2f}" for own, other in zip(errors, known, strict=True))]


def run(options: Options) -> None:
    console, lines = Console(width=120), []
    for i, (kind, lag) in enumerate(cases := list(product(options.kinds, options.lags))):
        with console.status(f"{lag} ms, {kind} flights: {i + 1} of {len(cases)}, about three minutes each"):
            lines.append(line(lag, kind, options))
    header = ("lag [ms]", "flights", "found (95 %)", "Ix [%]", "Iy [%]", "physics", "hybrid")
    title = "Lag and inertia from sampled rotor speeds; error over 0.1 s relative to that from averaged speeds"
    print_table(console, Table(title, header, lines, labels=2))


main = partial(command.call, "identification.rotor_lag", Options, run)

if __name__ == "__main__":
    main()
