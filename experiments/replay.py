"""Fly with the models of a run and watch it in 3-D: python -m experiments.replay --help"""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import tyro
from jaxtyping import Float
from matplotlib.animation import FuncAnimation, PillowWriter
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure

from experiments.flying.scenario import PATHS
from experiments.reporting.names import label
from experiments.reporting.plots import COLOURS
from experiments.runner import command
from hybrid_jax import checks, control, load, rollout
from hybrid_jax.control import Controller
from hybrid_jax.dynamics.base import AbstractVectorField
from hybrid_jax.sim.domain import DOMAINS, Domain
from hybrid_jax.state import POSITION, QUATERNION
from hybrid_jax.vehicle import IRIS

NAME = "replay"
SHOWN_EVERY = 5  # periods of the controller between two that are shown
FORECAST = 50  # periods that a model predicts from the true state, under the inputs that were flown
FRAMES_PER_SECOND = 10  # of the animated picture
REFERENCE_COLOUR = "#888888"

Positions = Float[np.ndarray, "t h 3"]
Reference = Literal["hover", "figure_eight", "fast_figure_eight", "step", "low_pass", "upset"]


@dataclass(frozen=True)
class Config:
    """Fly the changed vehicle with models that an experiment saved, and show each flight in 3-D over time.

    RUN is the folder of param_shift or external_force, with its report.json and models. A predictive controller flies
    with each model. Shown are the true vehicle, the controller's plan of the next second, the model's forecast of the
    next half second under the inputs that were flown, and the reference.

    Written are replay.rrd, which the viewer of rerun opens (pip install 'hybrid_jax[replay]', then: rerun replay.rrd),
    and replay.gif.
    """

    run: Annotated[Path, tyro.conf.Positional]
    """Folder that an experiment wrote, such as runs/param_shift."""
    models: tuple[str, ...] = ()
    """Names of files in RUN/models without .npz; by default the first seed's hybrid before and after adaptation."""
    reference: Reference = "figure_eight"
    """What to fly along."""
    seconds: float = 6.0
    """Length of the flight [s]."""
    out: Path | None = None
    """Folder for the files; by default RUN/replay."""


class Replay(NamedTuple):
    """A flight of t shown samples."""

    states: Float[np.ndarray, "t 13"]  # of the true vehicle
    plans: Positions  # where the controller means to be [m, world]
    forecasts: Positions  # where the model expects the vehicle
    errors: Float[np.ndarray, " t"]  # distance from the reference [m]


def replay(config: Config) -> None:
    checks.positive("--seconds", config.seconds, "a positive number of seconds")
    domain, models = _domain(config.run), _models(config)
    out = config.out or config.run / NAME
    checks.writable_folder("--out", out)
    recorder = _recorder(out / "replay.rrd")
    controller = Controller(IRIS)
    reference = control.sample(PATHS[config.reference], controller, config.seconds)
    start = reference[0] if config.reference != "upset" else control.add_body_rates(reference[0])
    flights = {}
    for name, field in models.items():
        print(f"flying with {name} ...", flush=True)
        flights[name] = _flown(field, domain, reference, start, controller)
        print(f"{name}: position RMSE {100 * np.sqrt(np.mean(flights[name].errors ** 2)):.1f} cm")
    wanted = np.asarray(reference[: len(next(iter(flights.values())).states) * SHOWN_EVERY : SHOWN_EVERY, POSITION])
    _record(recorder, flights, wanted, SHOWN_EVERY * controller.period)
    _animate(out / "replay.gif", flights, wanted, SHOWN_EVERY * controller.period, f"{label(domain.name)}: true flight")
    print(out / "replay.rrd", out / "replay.gif", sep="\n")


def _domain(run: Path) -> Domain:
    """Which system the models of a run were adapted to."""
    try:
        name = json.loads((run / "report.json").read_text())["rows"][0]["domain"]
        return DOMAINS[name]
    except (OSError, ValueError, KeyError, IndexError, TypeError) as error:
        expected = "expected the folder of param_shift or external_force, with its report.json"
        raise ValueError(f"{run}: {expected} ({checks.first_line(error)})") from error


def _models(config: Config) -> dict[str, AbstractVectorField]:
    """The fields to fly with, by the names of their files."""
    found = sorted((config.run / "models").glob("*.npz"))
    names = [path.stem for path in found]
    adapted = [name for name in names if name.startswith("hybrid-fine_tuned-") and name.endswith("-seed0")]
    adapted.sort(key=lambda name: int(name.split("-")[2]))
    chosen = config.models or ("hybrid-source_only-0-seed0", *adapted[:1])
    for name in chosen:
        if name not in names:
            raise ValueError(
                f"--models: {name} is not in {config.run / 'models'}, which has {', '.join(names) or 'none'}"
            )
    return {name: load(config.run / "models" / f"{name}.npz").field for name in chosen}


def _flown(field, domain: Domain, reference, start, controller: Controller) -> Replay:
    """Fly along the reference, and what was planned and forecast at the samples that are shown."""
    truth = domain.quadrotor()

    @eqx.filter_jit
    def fly(field):
        flight = control.fly(
            lambda x, u, t: truth.step(x, u, t, controller.period), field, reference, start, controller
        )
        shown = np.arange(0, len(flight.u) - FORECAST, SHOWN_EVERY)
        held = flight.u[shown[:, None] + np.arange(FORECAST)]

        def planned(x, plan):
            return rollout(field, x, controller.speeds(plan), controller.interval)[:, POSITION]

        def forecast(x, u):
            return rollout(field, x, u, controller.period)[:, POSITION]

        x, plans = flight.x[shown], jax.tree.map(lambda leaf: leaf[shown], flight.plans)
        error = jnp.linalg.norm((x - reference[shown])[:, POSITION], axis=1)
        return x, jax.vmap(planned)(x, plans), jax.vmap(forecast)(x, held), error

    return Replay(*map(np.asarray, fly(field)))


def _recorder(path: Path):
    """A recording of rerun that writes to a file; ImportError if rerun is not installed."""
    try:
        import rerun
    except ImportError as error:
        raise ImportError("the 3-D replay needs rerun: pip install 'hybrid_jax[replay]'") from error
    recorder = rerun.RecordingStream("hybrid_jax")
    recorder.save(path)
    return recorder


def _record(recorder, flights: Mapping[str, Replay], wanted: Float[np.ndarray, "t 3"], dt: float) -> None:
    """Log vehicle, plan, forecast and error of each flight over time, and the reference."""
    import rerun

    def lines(points, colour, radius: float | None = None):
        tints = [round(255 * part) for part in to_rgb(colour)]
        return rerun.LineStrips3D(points, colors=[tints] * len(points), radii=radius)

    recorder.log("world", rerun.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    recorder.log("world/reference", lines([wanted], REFERENCE_COLOUR), static=True)
    rotors = np.column_stack([IRIS.rotor_positions, np.zeros(len(IRIS.spin))])
    arms = [np.stack([np.zeros(3), rotor]) for rotor in rotors]
    for (name, flight), colour in zip(flights.items(), COLOURS.values(), strict=False):
        root = f"world/{name}"
        recorder.log(f"{root}/vehicle/arms", lines(arms, colour, 0.01), static=True)
        for i, state in enumerate(flight.states):
            recorder.set_time("flight", duration=i * dt)
            w, x, y, z = state[QUATERNION].tolist()
            pose = rerun.Transform3D(translation=state[POSITION], quaternion=rerun.Quaternion(xyzw=[x, y, z, w]))
            recorder.log(f"{root}/vehicle", pose)
            recorder.log(f"{root}/path", lines([flight.states[: i + 1, POSITION]], colour))
            recorder.log(f"{root}/plan", lines([flight.plans[i]], colour, 0.005))
            recorder.log(f"{root}/forecast", lines([flight.forecasts[i]], "black", 0.005))
            recorder.log(f"distance_from_reference/{name}", rerun.Scalars(float(flight.errors[i])))
    recorder.flush()


def _animate(path: Path, flights: Mapping[str, Replay], wanted, dt: float, title: str) -> None:
    """An animated picture of all flights, in real time."""
    figure = Figure(figsize=(6.4, 5.2), layout="constrained")
    axes = figure.add_subplot(projection="3d")
    axes.plot(*wanted.T, color=REFERENCE_COLOUR, linestyle="--", linewidth=1, label="reference")
    middle, half = (wanted.min(axis=0) + wanted.max(axis=0)) / 2, max(0.6, 0.6 * np.ptp(wanted, axis=0).max())
    limits = np.stack([middle - half, middle + half])
    axes.set(xlim=limits[:, 0], ylim=limits[:, 1], zlim=limits[:, 2], xlabel="x [m]", ylabel="y [m]", zlabel="z [m]")
    drawn = []
    for (name, flight), colour in zip(flights.items(), COLOURS.values(), strict=False):
        (trail,) = axes.plot([], [], [], color=colour, linewidth=1.2, label=name)
        (plan,) = axes.plot([], [], [], color=colour, linestyle=":", linewidth=2)
        (forecast,) = axes.plot([], [], [], color="black", linewidth=0.8)
        (vehicle,) = axes.plot([], [], [], "o", color=colour, markersize=6)
        drawn.append((flight, trail, plan, forecast, vehicle))
    axes.legend(loc="upper left", fontsize=8, title="dotted: plan, black: forecast", title_fontsize=8)
    every = max(round(1 / (FRAMES_PER_SECOND * dt)), 1)

    def frame(i: int):
        figure.suptitle(f"{title}, {i * dt:.1f} s")
        for flight, trail, plan, forecast, vehicle in drawn:
            here = flight.states[: i + 1, POSITION]
            for line, points in (
                (trail, here),
                (plan, flight.plans[i]),
                (forecast, flight.forecasts[i]),
                (vehicle, here[-1:]),
            ):
                line.set_data_3d(*np.where(np.abs(points - middle) < 4 * half, points, np.nan).T)

    moving = FuncAnimation(figure, frame, frames=range(0, len(wanted), every))  # pyright: ignore[reportArgumentType]
    moving.save(path, PillowWriter(fps=FRAMES_PER_SECOND))


main = partial(command.call, NAME, Config, replay)

if __name__ == "__main__":
    main()
