"""What an experiment leaves in its folder: the report, the figures and the models."""

from collections.abc import Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import numpy as np
from matplotlib.figure import Figure
from rich.console import Console

import hybrid_jax
from experiments.paper.claims import COMPARISON, claims
from experiments.paper.config import AdaptationConfig, Config
from experiments.paper.figures import scores, theta
from experiments.paper.flight_figures import example_flight, predictions
from experiments.paper.introduction import introduction
from experiments.paper.lanes import save_models
from experiments.paper.study import EVERY, Study, study
from experiments.paper.tables import by_size, parameters, ranking, run_notes
from experiments.reporting.claims import verdict_table
from experiments.reporting.names import FINE_TUNED, NO_PHYSICS, PHYSICS_ONLY, label
from experiments.reporting.plots import save_figures
from experiments.reporting.report import Report, write_report
from experiments.reporting.results import Results
from experiments.runner.environment import environment
from hybrid_jax.dynamics.rigid_body import nominal
from hybrid_jax.sim.domain import Domain
from hybrid_jax.sim.flight import DT, fly
from hybrid_jax.sweep import hosts
from hybrid_jax.sweep.lanes import lane
from hybrid_jax.vehicle import IRIS

FLIGHT_SECONDS = 11.0
FLOOR = "wind_sine_mse"  # the key of report.json for the share of L^T_MSE that is the wind's sine


def adapt_and_report(experiment: str, domain: Domain, floor: float, config: AdaptationConfig, console: Console) -> None:
    """Run the protocol on a target domain; write models, figures and, last, the report; print its tables.

    Args:
        floor: the share of the test error that no model ẋ = f(x, u) can remove.
    """
    found = study(domain, IRIS, config, console)
    if not hosts.is_main_process():
        return
    out, truth, rows = config.out / experiment, nominal(domain.vehicle), found.rows
    save_models(out / "models", found.lanes, rows)
    figures = save_figures(out, draw(domain, config, found, truth, floor))
    extra = {"flights": {"source": found.source.metadata, "target": found.target.metadata}}
    report = paper_report(experiment, config, found.seconds, rows, truth, figures, found.notes, floor, extra)
    write_report(out, report, Console())


def paper_report(
    experiment: str,
    config: Config,
    seconds: Mapping[str, float],
    rows: Results,
    truth: Mapping[str, Any] | None,
    figures: Mapping[str, str],
    notes: Sequence[str] = (),
    floor: float = 0.0,
    extra: Mapping[str, Any] | None = None,
) -> Report:
    """The report of an experiment of the paper.

    Args:
        truth: the true θ_p, by domain where there are several.
        figures: caption by file.
    """
    verdicts = claims(rows, experiment, truth)
    headline = ranking if experiment == COMPARISON else by_size
    sine = f"About {floor:.2e} of a test error in the wind is due to its sine, which no model without a clock can see."
    return Report(
        experiment=experiment,
        config=config.described(),
        environment=environment(seconds),
        rows=rows,
        claims=verdicts,
        figures=figures,
        notes=[*run_notes(rows), *notes, *([sine] if floor else [])],
        extra={"truth_theta": truth, **(extra or {}), **({FLOOR: floor} if floor else {})},
        head=introduction(experiment, rows),
        tables=[*headline(rows), verdict_table(verdicts, "Claims of the paper"), *parameters(rows, truth)],
    )


def draw(
    domain: Domain, config: AdaptationConfig, found: Study, truth: dict[str, float], floor: float
) -> dict[str, tuple[Figure, str]]:
    """Figs. 2/4, 3/5, 7 and the recovered parameters, with captions, by name."""
    title = label(domain.name).capitalize()
    flight = fly(domain, 1, FLIGHT_SECONDS, jax.random.key(config.data_seed))
    example = example_flight(np.asarray(flight.states[0]), np.asarray(flight.inputs[0]), DT)
    figures = {
        "scores": (scores(found.rows, title, floor), "Test error and gain against N (paper, Figs. 3, 5)"),
        "example_flight": (example, "A flight like those of the data (paper, Fig. 7)"),
    }
    if {*config.models} - {NO_PHYSICS}:
        figures["theta"] = (theta(found.rows, truth), "Physical parameters after training, against the truth")
    if {*config.models} - {PHYSICS_ONLY}:
        figures["predictions"] = (paths(title, found), "A test flight and its predictions (paper, Figs. 2, 4)")
    return figures


def paths(title: str, found: Study) -> Figure:
    """The test flight of median error of the first model, as every fine-tuned model of its seed predicts it."""
    tuned = [lanes for lanes in found.lanes if lanes.mode == FINE_TUNED and lanes.model != PHYSICS_ONLY]
    test = found.target.splits["test"]
    # Not `Model.predict`, which raises if a prediction diverges; the errors of such windows sort last.
    states = np.asarray(eqx.filter_jit(hybrid_jax.rollout_batch)(lane(tuned[0].fields, 0), test.x0, test.u, test.dt))
    errors = np.square(states - test.x)[:, EVERY - 1 :: EVERY].sum(-1).mean(-1)
    window = test[int(np.argsort(errors)[len(errors) // 2])]
    sizes = set(tuned[0].sizes)
    shown = {100, 500, 1000} & sizes or set(sorted(sizes)[:3])
    predicted: dict[int, dict[str, np.ndarray]] = {}
    for lanes in tuned:
        for i, (size, seed) in enumerate(zip(lanes.sizes, lanes.seeds, strict=True)):
            if seed == lanes.seeds[0] and size in shown:
                states = hybrid_jax.rollout(lane(lanes.fields, i), window.x0, window.u, window.dt)
                predicted.setdefault(size, {})[lanes.model] = np.vstack([window.x0, states])
    return predictions(np.vstack([window.x0, window.x]), predicted, f"{title}: one second of a test flight")
