"""From one airframe to another: python -m experiments.identification.nanobench --help"""

import itertools
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import tyro
from jaxtyping import Array, Float
from rich.console import Console

import hybrid_jax as hj
from experiments.identification.crazypad import ACTUATOR, VEHICLE, first_seconds, force_errors
from experiments.identification.record import rmse
from experiments.reporting.tables import Table, print_table
from experiments.runner import command
from hybrid_jax import runtime
from hybrid_jax.adaptation.ridge import defects
from hybrid_jax.dynamics import FrozenRates, HoldState, Terms
from hybrid_jax.dynamics.actuators import Actuated, actuated, rotor_speeds
from hybrid_jax.dynamics.disturbance import ConstantDisturbance
from hybrid_jax.dynamics.rigid_body import rigid_body
from hybrid_jax.estimation.least_squares import fit_least_squares
from hybrid_jax.flights import FlightLog, Recording, read_recording
from hybrid_jax.flights.checks.airborne import airborne, within
from hybrid_jax.flights.windows import cut_windows, errors_between
from hybrid_jax.identification import Layout, identify
from hybrid_jax.identification.log_checks import inputs_of
from hybrid_jax.vehicle import VELOCITY

OF_A = """B2_circle_slow_rep1 B2_circle_medium_rep1 B2_circle_fast_rep1 B3_figure8_slow_rep1 B3_figure8_fast_rep1
    B7_oval_fast_rep2 B8_star_medium_rep1 B10_lissajous_fast_rep1"""
OF_B = "B7_oval_slow_rep3 B2_circle_fast_rep3 B5_helix_fast_rep2 B8_star_fast_rep3"
SECONDS, DT, STEPS, STRIDE = 10.0, 0.01, 50, 10
PAST = 200  # intervals before a window: on flights of A that were left out fewer predict worse, and 400 no better
FIT_STEPS = 12  # of Levenberg–Marquardt, of which the first few count
FORCE = Layout(dt=DT, steps=50, most=200, disturbance=(0.0,) * 6)
LEARN = ("Ix", "Iy", "Iz", "k_rotors", "centre_of_mass", "torque_gain", "drag", "aerodynamic_moment", "rate_damping")
TEN = "adapted from A, ten seconds"
OBSERVED = ", past 2 s"  # of a model with the mean force and torque that it lacked in the past of a window
SCALE = np.repeat([0.1, 0.05, 0.2, 0.2], [3, 4, 3, 3]).astype(np.float32)  # of the errors of p, q, v and ω


@dataclass(frozen=True)
class Options:
    """From one airframe to another, in the data set NanoBench: flights of an airframe A, and of B, which replaced it.

    Each flight of B is left out in turn; the model learns from the others, or from ten seconds of each of them in turn.
    """

    folder: Annotated[Path, tyro.conf.Positional]
    """The flights of the data set, for example B2_circle_slow_rep1.csv.gz."""


def thrust_of(recordings: list[Recording], voltage: bool = True, start: Actuated | None = None, free=None) -> Actuated:
    """Fit the actuators to the accelerometer of some flights; without the voltage, with a constant gain."""
    own = ACTUATOR if voltage else replace(ACTUATOR, nominal_voltage=0.0, voltage_exponent=0.0)
    learn = ("curve", "time_constant", "voltage_exponent") if voltage else ("curve", "time_constant")
    field = start if start is not None else actuated(rigid_body(VEHICLE, ()), own, learn)
    return identify(field, recordings, FORCE, ("specific_force",), free=free).field  # pyright: ignore[reportReturnType]


def flight_of(recording: Recording, field: Actuated) -> FlightLog:
    """Resample the time in the air every 10 ms, with rotor speeds from commands and voltage."""
    command = recording.signals["command"]
    flights = airborne(recording)
    t = np.arange(flights[0][0], flights[-1][1], DT)
    u = inputs_of(recording, field)
    lead = round(0.5 / DT)
    speeds = rotor_speeds(field, command.t, u, t[0] + DT * np.arange(-lead, len(t) + 1))[lead:]

    def at(name: str) -> np.ndarray:
        signal = recording.signals[name]
        return np.stack([np.interp(t, signal.t, column) for column in np.asarray(signal.values).T], axis=1)

    x = np.concatenate([at("position"), at("attitude"), at("velocity"), at("rates")], axis=1)
    x[:, 3:7] /= np.linalg.norm(x[:, 3:7], axis=1, keepdims=True)
    return FlightLog(t, x, speeds, recording.name)[within(t, flights)]


def windows_of(recordings, field: Actuated, stride: int, steps: int = STEPS) -> hj.Trajectories:
    return cut_windows([flight_of(each, field) for each in recordings], steps, stride)


@eqx.filter_jit
def predicted(field, tests: hj.Trajectories, observed: bool) -> Float[Array, "n t 13"]:
    """Predict the states after each past; if `observed`, add the mean acceleration error in it."""
    x, u, dt = tests.x, tests.u, tests.dt
    past = hj.Trajectories(tests.x0, u[:, :PAST], x[:, :PAST], dt)
    lacked = defects(field, past).reshape(len(x), PAST, -1).mean(axis=1)[:, VELOCITY.start :]

    def predict(x0, u, value):
        return hj.rollout(hj.Hybrid(field, ConstantDisturbance(observed * value)), x0, u, dt)

    return jax.vmap(predict)(x[:, PAST - 1], u[:, PAST:], lacked)


def errors(field, tests: hj.Trajectories, observed: bool = False) -> list[float]:
    """RMS of position, velocity, rotation and rates after 0.1 and 0.5 s."""
    found = errors_between(predicted(field, tests, observed), jnp.asarray(tests.x[:, PAST:]))
    return [float(np.sqrt(np.mean(np.asarray(part)[:, at] ** 2))) for at in (9, 49) for part in found]


def fitted_to(start, windows: hj.Trajectories):
    return fit_least_squares(start, windows, max_steps=FIT_STEPS, scale=jnp.asarray(SCALE)).field


def run(options: Options) -> None:
    runtime.configure()
    console, columns = Console(width=150), Path(__file__).with_suffix(".toml")
    flown = OF_A.split(), OF_B.split()
    a, b = ([read_recording(options.folder / f"{name}.csv.gz", columns) for name in part] for part in flown)
    aware, constant = thrust_of(a), thrust_of(a, voltage=False)
    console.print("A:", {name: np.asarray(value).round(4).tolist() for name, value in aware.theta().items()})
    learned = windows_of(a, aware, 100)
    of_a = fitted_to(rigid_body(VEHICLE, LEARN, Terms()), learned)
    tens = [first_seconds(each, SECONDS)[0] for each in b]
    few = [thrust_of([each], start=aware, free=("curve",)) for each in tens]
    windows = [windows_of([one], each, STEPS) for one, each in zip(tens, few, strict=True)]
    adapted = [hj.adapt(of_a, each, learned_from=learned) for each in windows]
    console.print("Chosen from ten seconds:", [each.chosen for each in adapted])
    forces, scores = [], {}
    for i, left in enumerate(b):
        others = b[:i] + b[i + 1 :]
        fitted, gain = thrust_of(others, start=aware), thrust_of(others, voltage=False, start=constant)
        errors_few = np.concatenate([force_errors(each, left) for each in few[:i] + few[i + 1 :]])
        forces.append([*(rmse(force_errors(each, left)) for each in (aware, fitted)), rmse(errors_few)])
        console.print(Path(left.name).name, [f"{each:.3f}" for each in forces[-1]])
        tests = partial(windows_of, [left], stride=STRIDE, steps=PAST + STEPS)
        test, plain, short = tests(fitted), tests(gain), [tests(each) for each in few]
        simple = [fitted_to(rigid_body(VEHICLE), windows_of(others, each, 50)) for each in (gain, fitted)]
        models = {
            "constant state": [(HoldState(), test)],
            "frozen rates": [(FrozenRates(simple[1]), test)],
            "physics, constant gain": [(simple[0], plain)],
            "physics, voltage": [(simple[1], test)],
            "adapted from A": [(fitted_to(of_a, windows_of(others, fitted, 50)), test)],
            TEN: [(each.field, windows) for each, windows in zip(adapted, short, strict=True)],
        }
        for (name, pairs), observed in itertools.product(models.items(), (False, True)):
            if name == "constant state" and observed:
                continue
            line = scores.setdefault(name + OBSERVED * observed, [])
            line.append([errors(model, windows, observed) for model, windows in pairs])
            console.print(name + OBSERVED * observed, [[f"{each:.3f}" for each in one] for one in line[-1]])
    show(console, np.asarray(forces), {name: np.asarray(each) for name, each in scores.items()})


def show(console: Console, forces: Float[np.ndarray, "f 3"], scores: dict[str, Float[np.ndarray, "f m 8"]]) -> None:
    """Print tables of errors over all flights left out, and of those from ten seconds of each flight on the others."""

    def pooled(part) -> Float[np.ndarray, " e"]:
        return np.sqrt(np.mean(np.square(part), axis=0))

    def cells(numbers) -> tuple[str, ...]:
        return tuple(f"{each:.3f}" for each in numbers)

    names, other = ("p [m]", "v [m/s]", "R [rad]", "ω [rad/s]"), ~np.eye(len(forces), dtype=bool)
    pairs = {name: np.broadcast_to(each, (*other.shape, each.shape[-1])) for name, each in scores.items()}
    title = "Specific force along the thrust, RMSE [m/s²]"
    tables = [Table(title, ("from A alone", "fitted to B", "ten seconds of B"), [cells(pooled(forces))])]
    for at, part in ((0.1, slice(4)), (0.5, slice(4, 8))):
        lines = [(name, *cells(pooled(each[other])[part])) for name, each in pairs.items()]
        tables.append(Table(f"Flights of B left out, RMSE after {at} s", ("model", *names), lines))
        lines = []
        for j, flight in enumerate(OF_B.split()):
            own = {name: pooled(each[other[:, j], j])[part] for name, each in pairs.items()}
            best = np.min([each for name, each in own.items() if "adapted" not in name], axis=0)
            lines += [(flight, *cells(own[TEN + OBSERVED])), ("best baseline", *cells(best))]
        tables.append(Table(f"Ten seconds of a flight{OBSERVED}: the others after {at} s", ("flight", *names), lines))
    for table in tables:
        print_table(console, table)


main = partial(command.call, "identification.nanobench", Options, run)

if __name__ == "__main__":
    main()
