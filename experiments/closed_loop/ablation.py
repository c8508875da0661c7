"""Ablation of the invariant residual: its inputs and outputs, its adaptation, and the normalised quaternion."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Literal, NamedTuple

from rich.console import Console

from experiments.closed_loop.models import Trained, fused, train, with_statistics_of
from experiments.closed_loop.rows import Agent
from experiments.closed_loop.scenarios import ModelSet
from experiments.paper.config import Config, ResidualInputs, ResidualOutputs
from hybrid_jax.dynamics.base import AbstractVectorField
from hybrid_jax.sim.domain import Domain
from hybrid_jax.vehicle import Vehicle

Option = Literal["networks", "offset", "statistics", "quaternion"]
PAPER, INVARIANT = "paper: all of x → all 13", "invariant: no p_x, p_y, yaw → v̇, ω̇"
NETWORKS: dict[str, tuple[ResidualInputs, ResidualOutputs]] = {
    PAPER: ("all", "all"),
    "no p_x, p_y → all 13": ("no_xy", "all"),
    "all of x → v̇, ω̇": ("all", "accelerations"),
    "no p_x, p_y → v̇, ω̇": ("no_xy", "accelerations"),
    INVARIANT: ("no_xy_yaw", "accelerations"),
}
COMPARED = (PAPER, INVARIANT)  # the networks to which the other options apply
SLOW = "invariant, output bias at the common rate"


class Ablation(NamedTuple):
    """Trained networks by name, the seconds of their stages, and notes on these."""

    trained: dict[str, Trained]
    seconds: dict[str, float]
    notes: list[str]


def train_networks(
    options: Sequence[Option], vehicle: Vehicle, config: Config, console: Console, domains: Sequence[Domain]
) -> Ablation:
    """Train the networks that these options compare."""
    wanted = {name: NETWORKS[name] for name in NETWORKS if "networks" in options or name in COMPARED}
    if "offset" in options:
        wanted[SLOW] = NETWORKS[INVARIANT]
    made = Ablation({}, {}, [])
    for name, (inputs, outputs) in wanted.items():
        # A network that writes all derivatives is adapted as in the paper.
        fast = outputs == "accelerations" and name != SLOW
        rates = replace(config.rates, offset=config.rates.offset if fast else None)
        own = replace(config, residual_inputs=inputs, residual_outputs=outputs, rates=rates)
        made.trained[name], stages = train(f"ablation, {name}", "hybrid", vehicle, own, console, domains)
        made.seconds.update({f"ablation, {name}, {stage}": spent for stage, spent in stages.seconds.items()})
        made.notes.extend(f"{name}: {note}" for note in stages.notes())
    return made


def variants(options: Sequence[Option], domain: Domain, trained: dict[str, Trained], config: Config) -> ModelSet:
    """Models for the usual controller: each network adapted, with the statistics of the source, and unadapted with an
    observer.
    """
    (few,) = config.sizes

    def models() -> Iterator[tuple[Agent, AbstractVectorField]]:
        for name, found in trained.items():
            yield _agent(name, few), found.adapted[domain.name, few]
        if "statistics" in options and config.norm == "batch":
            for name in COMPARED:
                wrong = with_statistics_of(trained[name].source, trained[name].adapted[domain.name, few])
                yield _agent(f"{_short(name)}, batch statistics of the source", few), wrong
        for name in COMPARED:
            agent = _agent(f"{_short(name)}, not adapted, + observer", 0)
            yield replace(agent, observer=True), trained[name].source

    return {agent: fused(field) for agent, field in models()}


def unnormalised(domain: Domain, trained: dict[str, Trained], config: Config) -> ModelSet:
    """Models for a controller that does not renormalise the quaternion in its predictions."""
    (few,) = config.sizes
    fields = {name: trained[name].adapted[domain.name, few] for name in COMPARED}
    return {_agent(f"{_short(name)}, |q| not renormalised", few): fused(field) for name, field in fields.items()}


def _short(name: str) -> str:
    return name.partition(":")[0]


def _agent(variant: str, n_train: int) -> Agent:
    return Agent("invariant" if variant.startswith("invariant") else "hybrid", n_train, variant=variant)
