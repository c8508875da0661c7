"""A predictive controller flies with every model, before and after adaptation: python -m experiments.closed_loop"""

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import jax
from rich.console import Console

from experiments.closed_loop import models
from experiments.closed_loop.claims import FlightEvidence, Speed, claims
from experiments.closed_loop.config import PRESETS, ClosedLoopConfig
from experiments.closed_loop.figures import draw
from experiments.closed_loop.flights import DOMAINS, Flown, ModelSet, Scenario, fly_all, results_of
from experiments.closed_loop.models import Trained
from experiments.closed_loop.results import Agent, conclusion, gap_tables, main_table, speed_table, tables
from experiments.closed_loop.timing import call_times
from experiments.flying.timing import on_one_core
from experiments.paper.config import Config
from experiments.reporting.claims import evaluate, verdict_table, with_recorded
from experiments.reporting.questions import QUESTIONS
from experiments.reporting.report import Report, rows_in, write_report
from experiments.runner import command
from experiments.runner.run_record import record_of
from experiments.runner.stages import Stages, stages_of
from hybrid_jax.adaptation import LeastSquares
from hybrid_jax.dynamics.rigid_body import rigid_body
from hybrid_jax.sim.domain import PARAMETER_SHIFT, SOURCE
from hybrid_jax.sweep import hosts, lane
from hybrid_jax.vehicle import IRIS

NAME = "closed_loop"
FLIGHTS = "flights"
Training = dict[str, Stages]  # of each trained model, and of FLIGHTS
Places = Sequence[tuple[str, float]]  # reference, distance from home [m]
MODELS = {"physics": "physics_only", "hybrid": "hybrid", "no_physics": "no_physics"}  # as flown → as trained
DISTURBANCES = {"needed": LeastSquares(), "always": LeastSquares(disturbance=True)}
EXACT = "It knows the true state without noise."


def head(config: Mapping[str, Any]) -> str:
    noise, latency, lag = (config.get(name, 0.0) for name in ("noise", "latency", "rotor_lag"))
    if not (noise or latency or lag):
        return QUESTIONS[NAME].head.format(knows=EXACT)
    known = "controller and observer predict both"
    knows = (
        f"Noise of the sensors: {noise:g} times that of motion capture and a gyroscope. Latency {1e3 * latency:g} ms"
    )
    return QUESTIONS[NAME].head.format(knows=f"{knows}, lag of the rotors {1e3 * lag:g} ms; {known}.")


def experiment(config: ClosedLoopConfig, console: Console) -> None:
    training: Training = {}
    trained, training[FLIGHTS] = train_all(config, console, training), stages_of(config, console)
    flown = fly_models(config, trained, training)
    if hosts.is_main_process():
        write(config, trained, flown, training)


def train_one(console: Console, training: Training, name: str, model: str, config: Config) -> Trained:
    console.print(name, style="bold", highlight=False)
    training[name] = stages_of(config, console)
    return models.train(model, config, training[name])


def train_all(config: ClosedLoopConfig, console: Console, training: Training) -> dict[str, Trained]:
    trained = {name: train_one(console, training, name, model, config) for name, model in MODELS.items()}
    own = config.invariant()
    trained["invariant"] = train_one(console, training, "invariant", "hybrid", own)
    training["least squares"], solve = stages_of(own, console), DISTURBANCES[config.invariant_disturbance]
    source = trained["invariant"].source
    trained["least_squares"] = models.least_squares(source, solve, own, training["least squares"])
    return trained


def fly_models(config: ClosedLoopConfig, trained: dict[str, Trained], training: Training) -> list[Flown]:
    """Fly every model along every reference, before and after the changes; after them also away from home."""
    changed = {domain.name: models.model_set(domain, trained, config.ends) for domain in DOMAINS}
    sets = {SOURCE.name: models.model_set(SOURCE, trained, ()), **changed}
    home = scenarios(config, sets, [(name, 0.0) for name in config.references])
    away = scenarios(config, changed, [(name, config.away) for name in config.flown_away])
    return fly_all([*home, *away], config.controller(), config.seconds, training[FLIGHTS], config.hardware())


def scenarios(config: ClosedLoopConfig, sets: Mapping[str, ModelSet], places: Places) -> list[Scenario]:
    own = [domain for domain in (SOURCE, *DOMAINS) if domain.name in sets]
    return [Scenario(domain, *place, sets[domain.name], config.bandwidth) for domain in own for place in places]


def speeds(config: ClosedLoopConfig, trained: dict[str, Trained]) -> dict[str, dict[str, float]]:
    """Time one call on one core: with only physics, with the paper's network and with the invariant one."""
    few = min(config.sizes)
    fields = {Agent("nominal").name: rigid_body(IRIS)}
    for model in ("hybrid", "invariant"):
        fields[Agent(model, few).name] = lane(trained[model].adapted[PARAMETER_SHIFT.name, few], 0)
    times = on_one_core(call_times, jax.device_get([*fields.values()]), config.controller(), config.calls)
    return dict(zip(fields, times, strict=True))


def write(config: ClosedLoopConfig, trained: dict[str, Trained], flown: Sequence[Flown], training: Training) -> None:
    out, few, timed, rows = config.out / NAME, min(config.sizes), speeds(config, trained), results_of(flown)
    call, simulated = timed[Agent("hybrid", few).name], config.seconds * len(rows)
    spent, worked = sum(each.seconds for each in flown), sum(each.processor_seconds for each in flown)
    clock = Speed(call["processor_ms"], call["median_ms"], simulated, spent, worked, flown[0].devices)
    notes = [f"{name}: {note}" for name, stages in training.items() for note in stages.notes()]
    notes += [f"least squares: {note}" for note in models.disturbance_counts(trained["least_squares"])]
    seconds = {f"{name}, {stage}": taken for name, own in training.items() for stage, taken in own.seconds.items()}
    record = record_of(NAME, config, rows, seconds, notes, speed=timed, clock=clock._asdict())
    write_report(out, report(record), Console())


def report(record: Mapping[str, Any]) -> Report:
    rows, few = rows_in(record), min(record["config"]["sizes"])
    speed = Speed(**record["clock"]) if "clock" in record else None
    verdicts = with_recorded(evaluate(claims(few), FlightEvidence(rows, speed)), record)
    of_rows = [*main_table(rows, few), *tables(rows), *gap_tables(rows)]
    made = [verdict_table(verdicts, "Hypotheses"), *of_rows, speed_table(record["speed"])]
    return Report(record, draw(rows), made, conclusion(rows, few), verdicts, head(record["config"]))


ABOUT = "Does ten seconds of flight improve the control of a vehicle? A predictive controller flies every model."
main = partial(command.run, NAME, ABOUT, experiment, presets=PRESETS)

if __name__ == "__main__":
    main()
