"""Ablation of the invariant residual: its inputs and outputs, its adaptation, and the normalised quaternion."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Literal

from experiments.closed_loop.models import Trained, fused, with_statistics_of
from experiments.closed_loop.rows import Agent
from experiments.closed_loop.scenarios import ModelSet
from experiments.paper.config import Config, ResidualInputs, ResidualOutputs
from hybrid_jax.sim.domain import Domain

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


def train_networks(
    options: Sequence[Option], config: Config, train: Callable[[str, str, Config], Trained]
) -> dict[str, Trained]:
    """The networks that these options compare, trained by `train(name, model, config)`."""
    wanted = {name: NETWORKS[name] for name in NETWORKS if "networks" in options or name in COMPARED}
    if "offset" in options:
        wanted[SLOW] = NETWORKS[INVARIANT]
    trained = {}
    for name, (inputs, outputs) in wanted.items():
        # A network that writes all derivatives is adapted as in the paper.
        fast = outputs == "accelerations" and name != SLOW
        rates = replace(config.rates, offset=config.rates.offset if fast else None)
        own = replace(config, residual_inputs=inputs, residual_outputs=outputs, rates=rates)
        trained[name] = train(f"ablation, {name}", "hybrid", own)
    return trained


def variants(options: Sequence[Option], domain: Domain, trained: dict[str, Trained], config: Config) -> ModelSet:
    """Models for the usual controller: each network adapted, with the statistics of the source, and unadapted with an
    observer.
    """
    (few,) = config.sizes
    adapted = {name: found.adapted[domain.name, few] for name, found in trained.items()}
    models = {_agent(name, few): field for name, field in adapted.items()}
    if "statistics" in options and config.norm == "batch":
        for name in COMPARED:
            agent = _agent(f"{_short(name)}, batch statistics of the source", few)
            models[agent] = with_statistics_of(trained[name].source, adapted[name])
    for name in COMPARED:
        agent = _agent(f"{_short(name)}, not adapted, + observer", 0)
        models[replace(agent, observer=True)] = trained[name].source
    return {agent: fused(field) for agent, field in models.items()}


def unnormalised(domain: Domain, trained: dict[str, Trained], config: Config) -> ModelSet:
    """Models for a controller that does not renormalise the quaternion in its predictions."""
    (few,) = config.sizes
    fields = {name: trained[name].adapted[domain.name, few] for name in COMPARED}
    return {_agent(f"{_short(name)}, |q| not renormalised", few): fused(field) for name, field in fields.items()}


def _short(name: str) -> str:
    return name.partition(":")[0]


def _agent(variant: str, n_train: int) -> Agent:
    return Agent("invariant" if variant.startswith("invariant") else "hybrid", n_train, variant=variant)
