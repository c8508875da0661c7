"""Does ten seconds of flight make the vehicle fly better? Every model as what a predictive controller believes in.

python -m experiments.closed_loop --help
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, get_args

from rich.console import Console

from experiments.closed_loop.ablation import Option, networks, unnormalised, variants
from experiments.closed_loop.common_field import Believed
from experiments.closed_loop.lanes import Airspace, Block, Flights
from experiments.closed_loop.models import Trained, disturbed_seeds, fleet, nine_numbers, train, unchanged_fleet
from experiments.closed_loop.report import Outcome, write
from experiments.closed_loop.rows import Flyer
from experiments.closed_loop.timing import on_one_core
from experiments.paper.config import QUICK, SMOKE, Config, Rates, ResidualInputs, distinct, preset_like
from experiments.paper.solved import constant_disturbance, needed_disturbance
from experiments.runner import command
from hybrid_jax import checks
from hybrid_jax.control import Controller
from hybrid_jax.dynamics.rigid_body import rigid_body
from hybrid_jax.sim.domain import EXTERNAL_FORCE, PARAMETER_SHIFT, SOURCE, Domain
from hybrid_jax.sweep import hosts
from hybrid_jax.sweep.lanes import lane
from hybrid_jax.vehicle import IRIS

NAME = "closed_loop"
DOMAINS = (PARAMETER_SHIFT, EXTERNAL_FORCE)
MODELS = {"physics": "physics_only", "hybrid": "hybrid", "no_physics": "no_physics"}  # as flown → as trained
DISTURBANCES = {"needed": needed_disturbance, "always": constant_disturbance}
Reference = Literal["hover", "figure_eight", "fast_figure_eight", "step", "low_pass", "upset"]
Crew = dict[Flyer, Believed]
ABLATED: tuple[Reference, ...] = ("hover", "figure_eight", "low_pass")


@dataclass(frozen=True)
class ClosedLoopConfig(Config):
    """Train as param_shift and external_force do (what they left in --cache is used), then fly both targets with a
    model predictive controller that carries each model in turn: adapted with the smallest and the largest of --sizes.
    The vehicle as it was before flies with what was not adapted.
    """

    seconds: float = 10.0
    """Length of a flight [s]."""
    references: tuple[Reference, ...] = get_args(Reference)
    """What is flown at home."""
    away: float = 60.0
    """Distance from home [m] of the flights that are flown there as well."""
    away_references: tuple[Reference, ...] | None = None
    """What is flown there, of --references; by default hover, figure_eight and low_pass, if they are among these."""
    bandwidth: float = 10.0
    """Of the disturbance observer [rad/s]."""
    safe_inputs: ResidualInputs = "near_ground"
    """What the safe network sees (see --residual-inputs)."""
    safe_outputs: Literal["accelerations", "wrench", "rotors"] = "rotors"
    """What it adds to (see --residual-outputs)."""
    safe_linear: bool = True
    """A linear map goes past its hidden layer (see --residual-linear)."""
    safe_hidden: int = 64
    """Its hidden units, and those of the rotors' network."""
    safe_norm: Literal["batch", "none"] = "none"
    """Normalisation of its hidden layer."""
    safe_rates: tuple[float, ...] = (3e-3, 3e-4, 3e-5)
    """Its rates in pre-training, one after the other, each from the best of the one before; those of θ_p fall alike."""
    safe_source: int = 10_000
    """Source trajectories of the safe network, if --source-train is more."""
    safe_epochs: int = 2000
    """Its cap on epochs, if --max-epochs is more."""
    safe_offset: float | None = 0.3
    """In its adaptation, the rate of its output bias [m/s² or rad/s² a step]; see --rates.offset."""
    safe_disturbance: Literal["needed", "always"] = "needed"
    """The constant disturbance of its nine numbers: where left-out windows are predicted better with it, or always."""
    ablation: tuple[Option, ...] = get_args(Option)
    """What to undo of the safe network. networks: what it reads and writes. offset: the rate of its output bias.
    statistics: batch statistics of the target. quaternion: renormalised in each step of a prediction."""
    ablation_source: int = 3000
    """Source trajectories of the ablation's networks."""
    ablation_epochs: int = 400
    """Their cap on epochs."""
    calls: int = 300
    """Calls of the controller to time alone."""

    def __post_init__(self):
        Config.__post_init__(self)
        distinct("--references", self.references)
        if self.away_references is not None:
            distinct("--away-references", self.away_references)
        unknown = [name for name in self.flown_away if name not in self.references]
        if unknown:
            known = ", ".join(self.references)
            raise ValueError(f"--away-references must be among --references ({known}), got {', '.join(unknown)}")
        for option in ("seconds", "away", "bandwidth"):
            checks.positive(f"--{option}", getattr(self, option))
        if not self.safe_rates:
            raise ValueError("--safe-rates must be at least one")
        for rate in self.safe_rates:
            checks.positive("--safe-rates", rate)
        checks.count("--safe-hidden", self.safe_hidden)
        if self.safe_offset is not None:
            checks.positive("--safe-offset", self.safe_offset)
        if self.seconds < 1.0:
            raise ValueError(f"--seconds must be at least 1, got {self.seconds}")
        if self.calls < 1:
            raise ValueError(f"--calls must be at least 1, got {self.calls}")
        if self.residual_outputs != "all":
            raise ValueError(
                f"--residual-outputs {self.residual_outputs}: no_physics must write all derivatives; see the safe model"
            )

    @property
    def flown_away(self) -> tuple[Reference, ...]:
        """What is flown away from home, and at home as well."""
        if self.away_references is not None:
            return self.away_references
        return tuple(name for name in ABLATED if name in self.references)


PRESETS = {
    "paper": ClosedLoopConfig(),
    "quick": preset_like(
        ClosedLoopConfig, QUICK, sizes=(100, 1000), seconds=6.0, references=ABLATED, away_references=("hover",),
        ablation=(),
    ),
    "smoke": preset_like(
        ClosedLoopConfig, SMOKE, sizes=(20,), source_train=20, seconds=1.0, references=("hover", "low_pass"),
        away_references=("hover",), safe_hidden=8, safe_norm="batch", ablation=("statistics",), calls=20,
    ),
}  # fmt: skip


def experiment(config: ClosedLoopConfig, console: Console) -> None:
    """Train, fly and write what came of it."""
    outcome = Outcome()
    trained = models(config, console, outcome)
    few, many = min(config.sizes), max(config.sizes)
    crews = {domain.name: fleet(domain, IRIS, trained, few, many, config) for domain in DOMAINS}
    crews[SOURCE.name] = unchanged_fleet(IRIS, trained, config)
    fly_models(config, crews, console, outcome)
    if config.ablation:
        fly_ablation(config, console, outcome)
    if hosts.is_main_process():
        outcome.speeds = speeds(config, trained)
        write(NAME, config, outcome, Console())


def speeds(config: ClosedLoopConfig, trained: dict[str, Trained]) -> dict[str, dict[str, float]]:
    """How long a call takes on one core: with physics alone, with the paper's network and with the safe one."""
    few = min(config.sizes)
    fields = {Flyer("nominal"): rigid_body(IRIS)}
    fields |= {
        Flyer(name, few): lane(trained[name].adapted[PARAMETER_SHIFT.name, few], 0) for name in ("hybrid", "safe")
    }
    named = {flyer.name: field for flyer, field in fields.items()}
    return on_one_core(named, Controller(IRIS), config.calls, config.cache)


def models(config: ClosedLoopConfig, console: Console, outcome: Outcome) -> dict[str, Trained]:
    """Every model of the table, by its name there."""
    trained = {}
    for name, model in MODELS.items():
        trained[name] = _train(name, model, config, console, outcome)
    # Of the sizes only the two that fly: nobody else has trained this network.
    sizes = tuple(dict.fromkeys((min(config.sizes), max(config.sizes))))
    network: dict[str, Any] = {
        "residual_inputs": config.safe_inputs,
        "residual_outputs": config.safe_outputs,
        "residual_linear": config.safe_linear,
        "hidden": config.safe_hidden,
        "norm": config.safe_norm,
    }
    wanted = shared(config, sizes=sizes, pool=config.pooled(), rates=safe_rates(config), **network)
    own = limited(wanted, config.safe_source, config.safe_epochs)
    trained["safe"] = _train("safe", "hybrid", own, console, outcome)
    trained["nine"], stages = nine_numbers(
        trained["safe"].source, min(sizes), DISTURBANCES[config.safe_disturbance], own, console, DOMAINS
    )
    outcome.notes += [f"nine numbers: {note}" for note in disturbed_seeds(trained["nine"])]
    outcome.seconds |= {f"nine numbers, {stage}": seconds for stage, seconds in stages.seconds.items()}
    return trained


def fly_models(config: ClosedLoopConfig, crews: dict[str, Crew], console: Console, outcome: Outcome) -> None:
    """Every model along every reference, before and after the changes; after them away from home as well."""
    home = blocks_of((SOURCE, *DOMAINS), crews, [(name, 0.0) for name in config.references])
    away = blocks_of(DOMAINS, crews, [(name, config.away) for name in config.flown_away])
    flights = flown(config, Controller(IRIS), [*home, *away], console)
    outcome.home, outcome.away = flights[: len(home)], flights[len(home) :]


def fly_ablation(config: ClosedLoopConfig, console: Console, outcome: Outcome) -> None:
    """Train the ablation's networks and fly them, one change at a time."""
    few = shared(config, sizes=(min(config.sizes),), pool=config.pooled(), rates=offset_rates(config))
    small = limited(few, config.ablation_source, config.ablation_epochs)
    trained, seconds, notes = networks(config.ablation, IRIS, small, console, DOMAINS)
    outcome.seconds |= seconds
    outcome.notes += notes
    places = [(name, 0.0) for name in ABLATED if name in config.references] + [("hover", config.away)]
    crews = {domain.name: variants(config.ablation, domain, IRIS, trained, small) for domain in DOMAINS}
    outcome.ablation += flown(config, Controller(IRIS), blocks_of(DOMAINS, crews, places), console)
    if "quaternion" in config.ablation:
        crews = {domain.name: unnormalised(domain, IRIS, trained, small) for domain in DOMAINS}
        drifting = Controller(IRIS, unit_quaternion=False)
        outcome.ablation += flown(config, drifting, blocks_of(DOMAINS, crews, places), console)


def blocks_of(
    domains: Sequence[Domain], crews: Mapping[str, Mapping[Flyer, Believed]], places: Sequence[tuple[str, float]]
) -> list[Block]:
    """The crew of each domain, each of them along each reference, so far [m] from home."""
    return [Block(domain, *place, crews[domain.name]) for domain in domains for place in places]


def flown(config: ClosedLoopConfig, controller: Controller, blocks: list[Block], console: Console) -> list[Flights]:
    """The flights of blocks, all lanes by one program."""
    folder = config.cache / "closed_loop"
    space = Airspace(controller, config.seconds, config.bandwidth, blocks, folder, console, config.fresh)
    return [space.fly(block) for block in blocks]


def shared(config: ClosedLoopConfig, **changes: Any) -> Config:
    """What the configuration shares with other experiments, and so with what these have trained."""
    return Config(**{name: getattr(config, name) for name in Config.__dataclass_fields__} | changes)


def safe_rates(config: ClosedLoopConfig) -> Rates:
    """The learning rates of the safe network."""
    first, *others = config.safe_rates
    return replace(offset_rates(config), pretraining=first, decay=tuple(rate / first for rate in others))


def offset_rates(config: ClosedLoopConfig) -> Rates:
    """The learning rates of the ablation's networks: the usual ones, but for the output bias."""
    return config.rates if config.safe_offset is None else replace(config.rates, offset=config.safe_offset)


def limited(config: Config, source: int, epochs: int) -> Config:
    """The configuration with at most so much source flight and so many epochs."""
    return replace(config, source_train=min(config.source_train, source), max_epochs=min(config.max_epochs, epochs))


def _train(name: str, model: str, config: Config, console: Console, outcome: Outcome) -> Trained:
    found, stages = train(name, model, IRIS, config, console, DOMAINS)
    outcome.seconds |= {f"{name}, {stage}": seconds for stage, seconds in stages.seconds.items()}
    outcome.notes += [f"{name}: {note}" for note in stages.notes()]
    return found


def main() -> None:
    """The command line."""
    about = "Does ten seconds of flight make the vehicle fly better? A model predictive controller carries every model."
    command.run(NAME, about, experiment, presets=PRESETS)


if __name__ == "__main__":
    main()
