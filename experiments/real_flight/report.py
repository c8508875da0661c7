"""Write the report, rows, figures and models of an experiment on recorded flights."""

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import jax
import numpy as np
from rich.console import Console

import hybrid_jax
from experiments.real_flight.claims import verdicts
from experiments.real_flight.config import NANODRONE_STEPS
from experiments.real_flight.figures import (
    Curve,
    Restarted,
    colour_of,
    errors_by_size,
    errors_by_step,
    predicted_flight,
    residual_by_speed,
)
from experiments.real_flight.folds import Fold
from experiments.real_flight.models import physics_of, thrust_baseline
from experiments.real_flight.recipes import RECIPES
from experiments.real_flight.rows import Cell, cell_name, cells
from experiments.real_flight.study import Outputs
from experiments.real_flight.tables import choice_tables, fold_tables, log_tables, parameter_tables, score_tables
from experiments.real_flight.train import Experiment, TrainedModel
from experiments.reporting import report
from experiments.reporting.claims import verdict_table
from experiments.reporting.plots import save_figures
from experiments.reporting.tables import print_tables
from experiments.runner.environment import environment
from hybrid_jax.dynamics.base import AbstractVectorField
from hybrid_jax.dynamics.terms import nominal_values
from hybrid_jax.dynamics.vehicle_file import VehicleModel
from hybrid_jax.flights.splits import flight_of
from hybrid_jax.flights.windows import cut_windows, longest_segment
from hybrid_jax.io.files import json_value
from hybrid_jax.state import VELOCITY

PIECES = 6  # predictions in the figure of a flight
NOTES = (
    "Validation flights stop every training and are not among the N windows.",
    "An interval of θ_p takes the network as given and comes from windows of 10 steps that share no sample; it does "
    "not account for errors of the model.",
)


def write_report(name: str, experiment: Experiment, outputs: Outputs, console: Console) -> None:
    """Write models, figures and, last, the report; print its main tables."""
    out, rows, stages = experiment.config.out / name, outputs.table, experiment.stages
    save_models(out / "models", experiment, outputs)
    claims = verdicts(rows)
    main = [*score_tables(rows, experiment.dt), *([verdict_table(claims, "Hypotheses")] if claims else [])]
    records = [record for logs in experiment.logs.values() for record in logs.records]
    nominal = nominal_parameters(experiment.before)
    more = [*fold_tables(rows), *choice_tables(outputs.choices), *parameter_tables(rows, nominal), *log_tables(records)]
    extra = {
        "vehicle": {"before": asdict(experiment.before), "after": asdict(experiment.after)},
        "folds": [_fold_record(fold) for fold in outputs.folds],
        "choices": outputs.choices,
        "logs": {label: logs.records for label, logs in experiment.logs.items()},
    }
    written = report.Report(
        name,
        json_value(experiment.config.described()),
        json_value(environment(stages.seconds)),
        rows,
        claims,
        save_figures(out, make_figures(experiment, outputs)),
        [*stages.notes(), *NOTES],
        extra,
        head(name, experiment, outputs),
        [*main, *more],
    )
    report.write_report(out, written)
    print_tables(console, main)
    console.print(f"Folds, parameters and log checks: {out / 'report.md'}", highlight=False, soft_wrap=True)


def head(name: str, experiment: Experiment, outputs: Outputs) -> str:
    """Introduce the report to a reader who knows nothing of the experiment."""
    config, logs = experiment.config, experiment.logs
    flights = ", ".join(f"{len(each.logs)} {label}" for label, each in logs.items())
    seconds = {label: sum(record["seconds"] for record in each.records) for label, each in logs.items()}
    of = ", ".join(f"{label} {value:.0f} s" for label, value in seconds.items())
    recipes = "\n".join(f"- recipe **{recipe}**: {RECIPES[recipe].about}" for recipe in config.tried)
    trained = (
        f"Models are trained on the source's flights, then on N windows of the target's ({config.draw}), and predict "
        if "target" in logs
        else "Models are trained on flights and predict "
    )
    return f"""# {name}

{trained}held-out flights, open loop from every sample with the recorded rotor speeds.
{flights} flights ({of}{"; simulated" if config.simulated else ""}), in {len(outputs.folds)} folds by \
{config.folds_by}; {len(outputs.rows)} tests, {config.seeds} seeds.

- **hybrid**: a multirotor that learns {", ".join(experiment.before.learn)} (or what its recipe says), plus a small \
network of body-frame inputs
- **no-physics**: the same network with ṗ = v and the attitude's kinematics
- **physics-only**: the multirotor alone
- **rigid body + linear residual**: the nominal rigid body, and a linear map of state and input fitted to its residuals
- **fine-tuned**: from the source's model; **scratch**: from nominal values; **zero-shot**: the source's model as it is
{recipes}

Errors are lengths of vectors, of rotation the angle. An RMSE is over all test windows."""


def curves(experiment: Experiment, outputs: Outputs) -> dict[Cell, Curve]:
    """Compute errors at every step of the main cells, over the test windows of all folds."""
    nanodrone = experiment.config.protocol == "nanodrone"
    power, kind = (1, 1) if nanodrone else (2, 0)
    most = max(row["n_train"] for row in outputs.rows)
    found: dict[Cell, Curve] = {}
    for cell, group in cells(outputs.table).items():
        model, mode, n = cell
        if n not in (0, most) or (mode == "scratch" and model not in ("hybrid", "linear_residual")):
            continue
        by_seed = []
        for own in group.group("seed").values():
            weights, errors = own.numbers("windows"), np.array([outputs.by_step(row)[kind] for row in own])
            by_seed.append((np.tensordot(weights, errors**power, 1) / weights.sum()) ** (1 / power))
        found[cell] = Curve(np.mean(by_seed, axis=0), np.std(by_seed, axis=0))
    return found


def make_figures(experiment: Experiment, outputs: Outputs) -> dict[str, tuple[Any, str]]:
    """Draw all figures: name → figure and caption."""
    nanodrone, dt = experiment.config.protocol == "nanodrone", experiment.dt
    measure = "mean error" if nanodrone else "RMSE"
    caption = f"mean error over {NANODRONE_STEPS} steps" if nanodrone else "RMSE"
    steps = errors_by_step(curves(experiment, outputs), dt, "Error against horizon", measure)
    figures = {"errors_by_step": (steps, f"Error against horizon, {caption}, test flights of all folds")}
    if any(row["n_train"] for row in outputs.rows):
        by_size = errors_by_size(outputs.table, dt, "Error against the amount of target flight")
        figures["errors_by_size"] = (by_size, "Error against N, the number of target windows trained on")
    modes = ("fine_tuned", "source_only", "zero_shot")
    hybrids = {mode: outputs.trained[0, "hybrid", mode] for mode in modes if (0, "hybrid", mode) in outputs.trained}
    if hybrids:
        flight = _flight(experiment, outputs, next(iter(hybrids)))
        figures["predicted_flight"] = (flight, "A part of a test flight and its predictions")
        network = _residual(outputs.folds[0], hybrids)
        figures["residual_by_speed"] = (network, "Output of the network on test flights against speed")
    return figures


def save_models(folder: Path, experiment: Experiment, outputs: Outputs) -> None:
    """Save every trained model, with what is known about it."""
    scores = {tuple(row[tag] for tag in outputs.table.tags): row["scores"] for row in outputs.table}
    for (number, model, mode), trained in outputs.trained.items():
        fold = outputs.folds[number].name
        for run, seed in enumerate(trained.seeds):
            n = trained.size(run)
            about = {"tested_on": fold, "model": model, "mode": mode, "n_train": n, "seed": seed}
            about |= {"dt": experiment.dt, "scores": scores[fold, model, mode, n, seed]}
            name = f"fold{number}-{model}-{mode}-{n}-seed{seed}.npz"
            hybrid_jax.save(folder / name, trained.run(run), about)


def nominal_parameters(model: VehicleModel) -> dict[str, float]:
    """Nominal values of the learned parameters, entry by entry: "Ix", "k_rotors[2]", "aerodynamic_moment[0,1]"."""
    values = nominal_values(model.vehicle, model.terms)
    found = {}
    for name, value in physics_of(model, RECIPES["staged"]).theta().items():  # type: ignore
        array = np.reshape(values[name], np.shape(value))
        for place in np.ndindex(array.shape):
            found[f"{name}[{','.join(map(str, place))}]" if place else name] = float(array[place])
    return found


def _fold_record(fold: Fold) -> dict[str, Any]:
    parts = {part: [flight_of(log) for log in getattr(fold, part)] for part in ("train", "validation", "test")}
    return {"tested_on": fold.name} | parts


def _largest(trained: TrainedModel) -> AbstractVectorField:
    """The field of the first seed with the most windows."""
    return trained.run(int(np.argmax([len(subset) for subset in trained.subsets])))


def _flight(experiment: Experiment, outputs: Outputs, mode: str):
    config, dt = experiment.config, experiment.dt
    log, begin, windows = longest_segment(outputs.folds[0].test, config.longest)
    windows = windows[:PIECES]
    starts = begin + dt * config.longest * np.arange(len(windows))
    inside = dt * np.arange(config.longest + 1)
    fields = {(model, mode): _largest(outputs.trained[0, model, mode]) for model in config.models}
    fields["thrust", "nominal"] = thrust_baseline(experiment.after)

    def restarted(cell: tuple[str, str], field: AbstractVectorField) -> Restarted:
        states = np.asarray(hybrid_jax.rollout_batch(field, windows.x0, windows.u, windows.dt))
        pieces = [(at + inside, np.vstack([x0, x])) for at, x0, x in zip(starts, windows.x0, states, strict=True)]
        return Restarted(cell_name(*cell), colour_of(cell[0]), pieces)

    truth = np.concatenate([windows.x0[:1], *windows.x])
    title = f"Test flight {flight_of(log)}, predicted {dt * config.longest:.3g} s at a time"
    shown = [restarted(*each) for each in fields.items()]
    return predicted_flight(begin + dt * np.arange(len(truth)), truth, shown, title)


def _residual(fold: Fold, hybrids: Mapping[str, TrainedModel]):
    windows = cut_windows(fold.test, 1).windows
    x, u = windows.x0, windows.u[:, 0]

    def output(trained: TrainedModel) -> np.ndarray:
        field: Any = _largest(trained)
        return np.asarray(jax.jit(jax.vmap(field.residual))(x, u))

    named = {cell_name("hybrid", mode): output(trained) for mode, trained in hybrids.items()}
    return residual_by_speed(np.linalg.norm(x[:, VELOCITY], axis=1), named, "Output of the network against speed")
