"""Closed-loop flight with every model, before and after adaptation, as prediction model of a predictive controller.

python -m experiments.closed_loop --help
"""

from collections.abc import Mapping, Sequence
from functools import partial

from rich.console import Console

from experiments.closed_loop.ablation import train_networks, unnormalised, variants
from experiments.closed_loop.config import ABLATED, PRESETS, ClosedLoopConfig
from experiments.closed_loop.flown import Flown, flown
from experiments.closed_loop.models import Trained, disturbance_counts, least_squares, model_set, train
from experiments.closed_loop.report import Outcome, write
from experiments.closed_loop.rows import Agent
from experiments.closed_loop.scenarios import DOMAINS, ModelSet, Scenario
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
    trained = models(config, console, outcome)
    fly_models(config, trained, console, outcome)
    if config.ablation:
        fly_ablation(config, console, outcome)
    if hosts.is_main_process():
        outcome.speeds = speeds(config, trained)
        write(NAME, config, outcome, Console())


def train_one(console: Console, outcome: Outcome, name: str, model: str, config: Config) -> Trained:
    """Train a model and record its stages."""
    console.print(name, style="bold", highlight=False)
    stages = stages_of(config, console)
    found = train(model, config, stages)
    outcome.record(name, stages)
    return found


def models(config: ClosedLoopConfig, console: Console, outcome: Outcome) -> dict[str, Trained]:
    """All trained models by their id in `rows.LEARNED`."""
    trained = {name: train_one(console, outcome, name, model, config) for name, model in MODELS.items()}
    own = config.invariant()
    trained["invariant"] = train_one(console, outcome, "invariant", "hybrid", own)
    stages, solve = stages_of(own, console), DISTURBANCES[config.invariant_disturbance]
    trained["least_squares"] = least_squares(trained["invariant"].source, solve, own, stages)
    outcome.record("least squares", stages)
    outcome.notes += [f"least squares: {note}" for note in disturbance_counts(trained["least_squares"])]
    return trained


def fly_models(config: ClosedLoopConfig, trained: dict[str, Trained], console: Console, outcome: Outcome) -> None:
    """Fly every model along every reference, before and after the changes; after them also away from home."""
    changed = {domain.name: model_set(domain, trained, config.ends) for domain in DOMAINS}
    sets = {SOURCE.name: model_set(SOURCE, trained, ()), **changed}
    home = scenarios(config, sets, [(name, 0.0) for name in config.references])
    away = scenarios(config, changed, [(name, config.away) for name in config.flown_away])
    outcome.flown = fly_all(config, Controller(IRIS), [*home, *away], console)


def fly_ablation(config: ClosedLoopConfig, console: Console, outcome: Outcome) -> None:
    """Train and fly the networks of the ablation."""
    own = config.ablated()
    trained = train_networks(config.ablation, own, partial(train_one, console, outcome))
    places = [(name, 0.0) for name in ABLATED if name in config.references] + [("hover", config.away)]
    sets = {domain.name: variants(config.ablation, domain, trained, own) for domain in DOMAINS}
    outcome.ablation = fly_all(config, Controller(IRIS), scenarios(config, sets, places), console)
    if "quaternion" in config.ablation:
        sets = {domain.name: unnormalised(domain, trained, own) for domain in DOMAINS}
        controller = Controller(IRIS, unit_quaternion=False)
        outcome.ablation += fly_all(config, controller, scenarios(config, sets, places), console)


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


def main() -> None:
    """The command line."""
    about = "Does ten seconds of flight improve the control of a vehicle? A predictive controller flies every model."
    command.run(NAME, about, experiment, presets=PRESETS)


if __name__ == "__main__":
    main()
