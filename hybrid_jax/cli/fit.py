"""`hybrid-jax fit`: learn a vehicle from its logs, by physics alone or with a network, whichever predicts better."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import jax
import numpy as np
import tyro
from jaxtyping import Float, PRNGKeyArray

from hybrid_jax import checks
from hybrid_jax.adaptation import METHODS, Adaptation, adapt
from hybrid_jax.cli import errors, identify, page
from hybrid_jax.cli.choice import choose, expected
from hybrid_jax.cli.command import step
from hybrid_jax.cli.inspect import inspected, write_vehicle
from hybrid_jax.cli.logs import LISTS, STEPS, FlightOptions, Flights, raw_logs, read_flights, windows_of
from hybrid_jax.dynamics.base import AbstractVectorField
from hybrid_jax.dynamics.baselines import FrozenRates
from hybrid_jax.dynamics.composition import Hybrid
from hybrid_jax.dynamics.rigid_body import RIGID_BODY_SPACE
from hybrid_jax.dynamics.vehicle_file import LAG, VehicleModel, load_vehicle_model
from hybrid_jax.extrapolation import features_of
from hybrid_jax.flights.conversion import missing_states
from hybrid_jax.flights.load import find_logs, read_recording
from hybrid_jax.flights.log import FlightLog
from hybrid_jax.io.files import json_value
from hybrid_jax.io.models import save
from hybrid_jax.networks.factory import make_residual
from hybrid_jax.networks.mlp import InputScaling, zero_output
from hybrid_jax.training import Settings, fit, rates_by_group
from hybrid_jax.training.channels import scaled_loss
from hybrid_jax.trajectories import Trajectories

__all__ = ["LISTS", "Options", "run"]
TRAINED, VALIDATED = 2000, 500  # windows
FOLDS = 3  # at most so many groups of flights are left out in turn
HIDDEN, RATE, EPOCHS = 32, 3e-3, 60
IDENTIFIED = ("output", "learn", "anyway", "out", "columns", "topics", "motor_order")  # options of both
PHYSICS = "theta_least_squares"
QUANTILES = np.linspace(0.01, 0.99, 99)
FROZEN, CANDIDATES = "thrust, rates frozen", ("physics", "hybrid")  # the simplest first


@dataclass(frozen=True)
class Options(FlightOptions):
    """Learn a vehicle from the logs of its flights.

    Each flight is left out in turn: what is learned from the others chooses between physics alone and physics with a
    network, and says which error to expect on a flight that nobody has recorded.

    Logs with position, velocity, attitude, body rates, and rotor speeds or commands with --polynomial become flights.
    Logs that lack some of it are identified from: see hybrid-jax identify.
    """

    before: Annotated[Path, tyro.conf.Positional]
    """Folder of logs."""
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """File for the model."""
    vehicle: Path | None = None
    """Vehicle file: what is known, and in `learn` what is not. See docs/howto/vehicle.md. By default one is written
    from the logs into the folder of the page, with a mass of 1 kg and arms of 0.1 m: results are right up to these."""
    learn: tuple[str, ...] = ()
    """Parameters to learn, in place of those of the vehicle file."""
    dt: float = 0.01
    """Interval of the model [s]."""
    seed: int = 0
    """Of the network."""
    out: Path = Path("runs/fit")
    """Folder of the page."""


def run(options: Options) -> int:
    checks.positive("--dt", options.dt)
    checks.writable_folder("--out", options.out)
    checks.writable_folder("--output", options.output.parent)
    path = options.vehicle or _written(options)
    known = load_vehicle_model(path)
    if _identified(options, known):
        own = {name: getattr(options, name) for name in IDENTIFIED}
        return identify.run(identify.Options(folder=options.before, vehicle=path, **own))
    model = _learning(options, path, known)
    flights = read_flights(options.before, model.vehicle, options.dt, options)
    if len(flights.logs) < 2:
        raise ValueError(f"{options.before}: holds one flight; two at least, of which one is left out to judge by")
    key = jax.random.key(options.seed)
    with step("leaving out flights in turn") as told:
        # One scale of errors for all flights, so that all trainings share a program.
        settings = Settings(objective=scaled_loss(model.physics(), _windows(flights.logs, TRAINED)))
        found = _left_out(model, flights.logs, key, settings)
        ends = {name: each[:, -1] for name, each in found.items()}
        scores = {name: np.log(ends[name] / ends[FROZEN]).mean(axis=1)[:, None] for name in CANDIDATES}
        chosen = choose(scores, CANDIDATES[:1])
        told(f"{chosen} predicts them best")
    with step(f"learning {chosen} from all flights"):
        windows = windows_of(flights.logs, STEPS, STEPS, TRAINED).windows
        physics = adapt(model.physics(), windows, method=PHYSICS, settings=settings)
        field: AbstractVectorField = physics.field
        if chosen == "hybrid":
            field = _hybrid(physics.field, flights.logs, key, settings)
    value, low, high = expected(np.log(ends[chosen]))
    errors_by_name = {name: list(each) for name, *each in zip(errors.UNITS, value, low, high, strict=True)}
    about = _about(options, model, flights, windows) | {"chosen": chosen, "expected": errors_by_name}
    save(options.output, field, json_value(about))
    shown = _page(options, flights, physics, found, chosen, (value, low, high))
    page.write(options.out, "fit", shown, about | {"model": options.output, "adaptation": physics.to_dict()})
    return 0


def _written(options: Options) -> Path:
    """A vehicle file of what the logs tell."""
    path = options.out / "vehicle.toml"
    with step(f"writing {path}, as no --vehicle is given"):
        read, _ = raw_logs(options.before, lambda log: inspected(log, None, options))
        write_vehicle(path, [log for _, log in read], options.before)
    return path


def _identified(options: Options, known: VehicleModel) -> bool:
    """Whether the first log lacks what training on flights needs, by what it measured."""
    paths = find_logs(options.before)[0] if options.before.is_dir() else [options.before]
    found = next((read_recording(path, **options.reading) for path in paths if path.exists()), None)
    if found is None:
        return False  # which is refused where all logs are read
    commands = known.actuator is not None and not options.polynomial and "rotor_speed" not in found.signals
    return commands or bool({*missing_states(found)} - {"motors"})


def _learning(options: Options, path: Path, model: VehicleModel) -> VehicleModel:
    """The vehicle with the names that are learned."""
    learn = tuple(name for name in options.learn or model.learn if name != LAG)
    if not learn:
        raise ValueError(f"{path}: learn: names nothing; give --learn Ix Iy, or what else is not known")
    return VehicleModel(model.vehicle, model.terms, model.actuator, learn, model.purpose)


def _windows(logs: Sequence[FlightLog], count: int) -> Trajectories:
    """So many windows, spread evenly, some twice where there are fewer, so that trainings share a program."""
    windows = windows_of(logs, STEPS, 1, count).windows
    return windows[np.arange(count) % len(windows)]


def _left_out(
    model: VehicleModel, logs: Sequence[FlightLog], key: PRNGKeyArray, settings: Settings
) -> dict[str, Float[np.ndarray, "flights t 4"]]:
    """RMSE (flights, t, 4) on flights left out, of thrust with frozen rates and of each candidate."""
    groups = [range(i, len(logs), min(FOLDS, len(logs))) for i in range(min(FOLDS, len(logs)))]
    parts: dict[str, list[Float[np.ndarray, "f t 4"]]] = {name: [] for name in (FROZEN, *CANDIDATES)}
    for group in groups:
        kept = [log for i, log in enumerate(logs) if i not in group]
        train = _windows(kept, TRAINED)
        physics = METHODS[PHYSICS].solve(model.physics(), train, train, settings).field
        fields = FrozenRates(model.physics()), physics, _hybrid(physics, kept, key, settings)
        for name, field in zip(parts, fields, strict=True):
            parts[name].append(errors.rmse_by_flight(field, [logs[i] for i in group], STEPS))
    order = np.argsort(np.concatenate(groups))
    return {name: np.concatenate(each)[order] for name, each in parts.items()}


def _hybrid(physics: Any, logs: Sequence[FlightLog], key: PRNGKeyArray, settings: Settings) -> AbstractVectorField:
    """Physics with a network that adds accelerations; of more than two flights the last one tells when to stop."""
    learned, validating = (logs[:-1], logs[-1:]) if len(logs) > 2 else (logs, logs)
    train, validation = _windows(learned, TRAINED), _windows(validating, VALIDATED)
    vehicle = physics.vehicle
    scaling = InputScaling(vehicle.hover_speed, vehicle.hover_speed / 10)
    options: dict[str, Any] = {"hidden": HIDDEN, "norm": "none", "scaling": scaling, "vehicle": vehicle}
    residual = zero_output(make_residual(key, inputs="body_motion", outputs="accelerations", **options))
    field = Hybrid(physics, residual)
    rates = rates_by_group(field, {"residual": RATE})
    return fit(field, train, validation, key, rates=rates, min_epochs=0, max_epochs=EPOCHS, settings=settings).best


def _about(options: Options, model: VehicleModel, flights: Flights, windows: Trajectories) -> dict[str, Any]:
    """What other verbs must know of the model."""
    features = features_of(windows, RIGID_BODY_SPACE)
    motion = {name: np.quantile(values, QUANTILES).tolist() for name, values in features.items()}
    own = {"dt": options.dt, "steps": STEPS, "vehicle": model.vehicle.name, "polynomial": list(options.polynomial)}
    return own | {"learned_from": flights.contents, "motion": motion}


def _page(
    options: Options, flights: Flights, physics: Adaptation, found: dict[str, Any], chosen: str, ends
) -> page.Page:
    seconds, frozen = STEPS * options.dt, found[FROZEN][:, -1]
    better = float(np.exp(np.log(frozen / found[chosen][:, -1]).mean()))
    cells = [errors.texts(each) for each in (*ends, np.exp(np.log(frozen).mean(axis=0)))]
    rows = [(name.replace("_", " "), *numbers) for name, *numbers in zip(errors.UNITS, *cells, strict=True)]
    by_flight = [
        (name, *(f"{np.exp(np.log(found[each][i, -1] / frozen[i]).mean()):.3g}" for each in CANDIDATES))
        for i, name in enumerate(flights.contents)
    ]
    network = "a network beside it predicts better still" if chosen == "hybrid" else "a network beside it adds nothing"
    return page.Page(
        f"What do {len(flights.logs)} flights of {options.before} tell of the vehicle?",
        f"Predictions of {seconds:g} s on flights left out are {better:.2g} times as exact as with frozen rates.",
        page.Table(
            f"Error to expect after {seconds:g} s on a flight that nobody has recorded",
            ("quantity", "RMSE", "80 % from", "to", FROZEN),
            rows,
        ),
        [("RMSE on flights that were left out", errors.figure(found, options.dt))],
        [f"The model is {chosen}: {network}.", *errors.unknown(physics)],
        [f"After a change: hybrid-jax adapt {options.output} AFTER -o adapted.npz, with ten seconds of flight."],
        [
            errors.parameter_table(physics),
            page.Table(f"Error on each flight left out, over that of {FROZEN}", ("flight", *CANDIDATES), by_flight),
        ],
        flights.said,
    )
