"""What an experiment leaves in its folder: the report, the figures and the models."""

from pathlib import Path

import equinox as eqx
import jax
import numpy as np
from rich.console import Console

import hybrid_jax
from experiments.paper.claims import claims
from experiments.paper.config import AdaptationConfig
from experiments.paper.figures import save_figure, scores, theta
from experiments.paper.flight_figures import example_flight, predictions
from experiments.paper.results import Lanes, save_models
from experiments.paper.study import EVERY, Study
from experiments.reporting.report import FLOOR, Report, print_report, write_report
from experiments.runner.environment import environment
from hybrid_jax.sim.domain import Domain
from hybrid_jax.sim.flight import DT, fly

FLIGHT_SECONDS = 11.0


def write_outcome(
    experiment: str,
    title: str,
    domain: Domain,
    config: AdaptationConfig,
    found: Study,
    console: Console,
    floor: float = 0.0,
) -> Report:
    """Write figures, models and, last, the report; print its tables.

    Args:
        floor: the share of the test error that no model of ẋ = f(x, u) can remove.
    """
    out = config.out / experiment
    truth = hybrid_jax.rigid_body(domain.vehicle)
    truth_theta = {name: float(value) for name, value in truth.theta().items()}
    save_models(out / "models", found.lanes, found.rows)
    report = Report(
        experiment=experiment,
        config=config.described(),
        environment=environment(found.seconds),
        rows=found.rows,
        claims=claims(found.rows, experiment, truth_theta),
        truth_theta=truth_theta,
        figures=draw(out, title, domain, config, found, truth_theta, floor),
        notes=found.notes,
        extra={"flights": {"source": found.source.metadata, "target": found.target.metadata}}
        | ({FLOOR: floor} if floor else {}),
    )
    write_report(out, report)
    print_report(console, report)
    return report


def draw(
    out: Path, title: str, domain: Domain, config: AdaptationConfig, found: Study, truth: dict[str, float], floor: float
) -> dict[str, str]:
    """Figs. 2/4, 3/5, 7 and the recovered parameters, as PNG and SVG; file → caption."""
    states, inputs = example(domain, config.data_seed)
    figures = {
        "scores": (
            scores(found.rows, title, floor),
            "Test error and gain against N (paper, Figs. 3, 5)",
        ),
        "example_flight": (example_flight(states, inputs, DT), "A flight like those of the data (paper, Fig. 7)"),
    }
    if {*config.models} - {"no_physics"}:
        figures["theta"] = (theta(found.rows, truth), "Physical parameters after training, against the truth")
    if {*config.models} - {"physics_only"}:
        figures["predictions"] = (paths(title, found), "A test flight and its predictions (paper, Figs. 2, 4)")
    for name, (figure, _) in figures.items():
        save_figure(figure, out / name)
    return {f"{name}.png": caption for name, (_, caption) in figures.items()}


def example(domain: Domain, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """One flight of the domain: states and inputs."""
    flight = fly(domain, 1, FLIGHT_SECONDS, jax.random.key(seed))
    return np.asarray(flight.states[0]), np.asarray(flight.inputs[0])


def paths(title: str, found: Study):
    """The test flight of median error, as every fine-tuned model of seed 0 predicts it."""
    tuned = [lanes for lanes in found.lanes if lanes.mode == "fine_tuned" and lanes.model != "physics_only"]
    test = found.target.splits["test"]
    window = test[_typical(tuned[0], test)]
    predicted: dict[int, dict[str, np.ndarray]] = {}
    for lanes in tuned:
        for i, (size, seed) in enumerate(zip(lanes.sizes, lanes.seeds, strict=True)):
            if seed == lanes.seeds[0] and size in _shown(lanes.sizes):
                states = hybrid_jax.rollout(lanes.field(i), window.x0, window.u, window.dt)
                predicted.setdefault(size, {})[lanes.model] = np.vstack([window.x0, states])
    return predictions(np.vstack([window.x0, window.x]), predicted, f"{title}: one second of a test flight")


def _typical(lanes: Lanes, test: hybrid_jax.Trajectories) -> int:
    # Not `Model.predict`, which refuses a lane that diverges; the errors of such windows sort last.
    predicted = np.asarray(eqx.filter_jit(hybrid_jax.rollout_batch)(lanes.field(0), test.x0, test.u, test.dt))
    errors = np.square(predicted - test.x)[:, EVERY - 1 :: EVERY].sum(-1).mean(-1)
    return int(np.argsort(errors)[len(errors) // 2])


def _shown(sizes) -> set[int]:
    wanted = {100, 500, 1000} & set(sizes)
    return wanted or set(sorted(set(sizes))[:3])
