"""Closed-loop flight with every model, before and after adaptation, as prediction model of a predictive controller.

python -m experiments.closed_loop --help
"""

from collections.abc import Mapping, Sequence
from functools import partial

from rich.console import Console

from experiments.closed_loop import models
from experiments.closed_loop.config import ABLATED, PRESETS, ClosedLoopConfig
from experiments.closed_loop.flights import DOMAINS, Flown, ModelSet, Scenario, flown
from experiments.closed_loop.models import Trained
from experiments.closed_loop.report import Outcome, write
from experiments.closed_loop.results import Agent
from experiments.closed_loop.timing import on_one_core
from experiments.paper.config import Config
from experiments.runner import command
from experiments.runner.stages import stages_of
from hybrid_jax.adaptation import LeastSquares
from hybrid_jax.control import Controller
from hybrid_jax.dynamics.rigid_body import rigid_body
from hybrid_jax.sim.domain import PARAMETER_SHIFT, SOURCE
from hybrid_jax.sweep import hosts
from hybrid_jax.sweep.lanes import lane
from hybrid_jax.vehicle import IRIS

NAME = "closed_loop"
Places = Sequence[tuple[str, float]]  # reference, distance from home [m]
MODELS = {"physics": "physics_only", "hybrid": "hybrid", "no_physics": "no_physics"}  # as flown → as trained
DISTURBANCES = {"needed": LeastSquares(), "always": LeastSquares(disturbance=True)}


def experiment(config: ClosedLoopConfig, console: Console) -> None:
    """Train, fly and write the report."""
    outcome = Outcome()
    trained = train_all(config, console, outcome)
    outcome.flown = fly_models(config, trained, console)
    if config.ablation:
        outcome.ablation = fly_ablation(config, console, outcome)
    if hosts.is_main_process():
        outcome.speeds = speeds(config, trained)
        write(NAME, config, outcome, Console())


def train_one(console: Console, outcome: Outcome, name: str, model: str, config: Config) -> Trained:
    """Train a model and record its stages."""
    console.print(name, style="bold", highlight=False)
    stages = stages_of(config, console)
    found = models.train(model, config, stages)
    outcome.record(name, stages)
    return found


def train_all(config: ClosedLoopConfig, console: Console, outcome: Outcome) -> dict[str, Trained]:
    """All trained models by their id in `results.LEARNED`."""
    trained = {name: train_one(console, outcome, name, model, config) for name, model in MODELS.items()}
    own = config.invariant()
    trained["invariant"] = train_one(console, outcome, "invariant", "hybrid", own)
    stages, solve = stages_of(own, console), DISTURBANCES[config.invariant_disturbance]
    trained["least_squares"] = models.least_squares(trained["invariant"].source, solve, own, stages)
    outcome.record("least squares", stages)
    outcome.notes += [f"least squares: {note}" for note in models.disturbance_counts(trained["least_squares"])]
    return trained


def fly_models(config: ClosedLoopConfig, trained: dict[str, Trained], console: Console) -> list[Flown]:
    """Fly every model along every reference, before and after the changes; after them also away from home."""
    changed = {domain.name: models.model_set(domain, trained, config.ends) for domain in DOMAINS}
    sets = {SOURCE.name: models.model_set(SOURCE, trained, ()), **changed}
    home = scenarios(config, sets, [(name, 0.0) for name in config.references])
    away = scenarios(config, changed, [(name, config.away) for name in config.flown_away])
    return fly_all(config, Controller(IRIS), [*home, *away], console)


def fly_ablation(config: ClosedLoopConfig, console: Console, outcome: Outcome) -> list[Flown]:
    """Train and fly the networks of the ablation."""
    own = config.ablated()
    trained = models.train_networks(config.ablation, own, partial(train_one, console, outcome))
    places = [(name, 0.0) for name in ABLATED if name in config.references] + [("hover", config.away)]
    found = []
    for unit in (True, False) if "quaternion" in config.ablation else (True,):
        sets = {domain.name: models.variants(config.ablation, domain, trained, own, unit) for domain in DOMAINS}
        found += fly_all(config, Controller(IRIS, unit_quaternion=unit), scenarios(config, sets, places), console)
    return found


def scenarios(config: ClosedLoopConfig, sets: Mapping[str, ModelSet], places: Places) -> list[Scenario]:
    """The models of each domain along each reference at each distance from home [m]."""
    own = [domain for domain in (SOURCE, *DOMAINS) if domain.name in sets]
    return [Scenario(domain, *place, sets[domain.name], config.bandwidth) for domain in own for place in places]


def fly_all(config: ClosedLoopConfig, controller: Controller, own: list[Scenario], console: Console) -> list[Flown]:
    """Fly scenarios with one controller, or find them in the cache."""
    return flown(own, controller, config.seconds, config.cache / NAME, console, config.fresh)


def speeds(config: ClosedLoopConfig, trained: dict[str, Trained]) -> dict[str, dict[str, float]]:
    """Time of one call on one core: with physics alone, with the paper's network and with the invariant one."""
    few = min(config.sizes)
    fields = {Agent("nominal").name: rigid_body(IRIS)}
    for model in ("hybrid", "invariant"):
        fields[Agent(model, few).name] = lane(trained[model].adapted[PARAMETER_SHIFT.name, few], 0)
    return on_one_core(fields, Controller(IRIS), config.calls, config.cache)


ABOUT = "Does ten seconds of flight improve the control of a vehicle? A predictive controller flies every model."
main = partial(command.run, NAME, ABOUT, experiment, presets=PRESETS)

if __name__ == "__main__":
    main()
