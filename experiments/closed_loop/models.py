"""Train or load every prediction model of the closed loop; all stages come from the shared cache."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import equinox as eqx
import jax
import numpy as np
from rich.console import Console

from experiments.closed_loop.rows import SOURCES, Agent
from experiments.closed_loop.scenarios import ModelSet
from experiments.closed_loop.true_model import true_field
from experiments.paper.config import Config
from experiments.paper.solved import solved
from experiments.paper.study import adapted, flown, places, pretrained, source_splits, target_splits
from experiments.runner.stages import Stages, stages_of
from hybrid_jax.adaptation import Method
from hybrid_jax.dynamics.base import AbstractVectorField, fuse_for_inference
from hybrid_jax.dynamics.rigid_body import rigid_body
from hybrid_jax.networks.normalisation import BatchNorm
from hybrid_jax.sim.domain import SOURCE, Domain
from hybrid_jax.sweep.lanes import lane
from hybrid_jax.vehicle import Vehicle


@dataclass(frozen=True)
class Trained:
    """A model before and after adaptation, stacked over seeds; `adapted` by domain and N."""

    source: AbstractVectorField
    adapted: dict[tuple[str, int], AbstractVectorField]


def train(
    name: str, model: str, vehicle: Vehicle, config: Config, console: Console, domains: Sequence[Domain]
) -> tuple[Trained, Stages]:
    """Pre-train a model and adapt it to each domain.

    Args:
        name: printed above the stages.
        model: id in `experiments.paper.conditions`.
    """
    console.print(name, style="bold", highlight=False)
    stages = stages_of(config, console)
    start = pretrained(model, vehicle, config, stages, flown(SOURCE, source_splits(config), config, stages)).best
    sizes, _ = places(config.sizes, config)
    found = {}
    for domain in domains:
        target = flown(domain, target_splits(config), config, stages)
        final = adapted(model, "fine_tuned", start, config, stages, target).best
        for size in config.sizes:
            found[domain.name, size] = lane(final, np.flatnonzero(np.equal(sizes, size)))
    return Trained(start, found), stages


def least_squares(
    source: AbstractVectorField, size: int, method: Method, config: Config, console: Console, domains: Sequence[Domain]
) -> tuple[Trained, Stages]:
    """Fit θ_p and a constant disturbance of the source models to each domain by least squares."""
    stages, own = stages_of(config, console), replace(config, sizes=(size,))

    def fit(domain: Domain) -> AbstractVectorField:
        target = flown(domain, target_splits(config), config, stages)
        return solved(f"least squares {domain.name}", method, source, own, stages, target).fields

    return Trained(source, {(domain.name, size): fit(domain) for domain in domains}), stages


def disturbance_counts(fitted: Trained) -> list[str]:
    """For each domain a sentence on how many seeds have a constant disturbance."""
    fields: dict[tuple[str, int], Any] = {**fitted.adapted}
    values = {domain: np.asarray(field.physics.residual.value) for (domain, _), field in fields.items()}
    counts = {domain: np.any(value != 0, axis=1) for domain, value in values.items()}
    return [f"{domain}: {found.sum()} of {len(found)} seeds have a disturbance." for domain, found in counts.items()]


def model_set(domain: Domain, vehicle: Vehicle, trained: dict[str, Trained], few: int, many: int) -> ModelSet:
    """All models that fly in a target domain, by agent.

    Args:
        trained: by id in `rows.LEARNED`.
        few, many: numbers of target trajectories.
    """
    fields: dict[Agent, Any] = {Agent("nominal"): as_stack(rigid_body(vehicle))}
    for model, found in trained.items():
        if model in SOURCES.values():
            fields[Agent(model)] = found.source
        sizes = (few,) if model in ("physics", "least_squares") else dict.fromkeys((few, many))
        fields |= {Agent(model, size): found.adapted[domain.name, size] for size in sizes}
    observed = [Agent("nominal"), *_sources(), *(Agent(model, few) for model in SOURCES)]
    return _complete(domain, vehicle, fields, observed)


def unchanged_model_set(vehicle: Vehicle, trained: dict[str, Trained]) -> ModelSet:
    """All models that fly the vehicle before the change: those that were not adapted."""
    fields = {Agent("nominal"): as_stack(rigid_body(vehicle))}
    fields |= {agent: trained[agent.model].source for agent in _sources()}
    return _complete(SOURCE, vehicle, fields, list(fields))


def _sources() -> list[Agent]:
    """The hybrids before adaptation."""
    return [Agent(model) for model in dict.fromkeys(SOURCES.values())]


def _complete(domain: Domain, vehicle: Vehicle, fields: dict[Agent, Any], observed: Sequence[Agent]) -> ModelSet:
    """These models, those `observed` also with an observer, and the true one."""
    models = {agent: fused(field) for agent, field in fields.items()}
    models |= {replace(agent, observer=True): models[agent] for agent in observed}
    return models | {Agent("oracle"): as_stack(true_field(domain, vehicle))}


def fused(fields: AbstractVectorField) -> AbstractVectorField:
    """Stacked fields in their inference layout, on the host."""
    return jax.device_get(eqx.filter_jit(eqx.filter_vmap(fuse_for_inference))(fields))


def as_stack(field: Any) -> Any:
    """One field as a stack of one."""
    return jax.tree.map(lambda leaf: np.asarray(leaf)[None], field)


def with_statistics_of(source: AbstractVectorField, field: AbstractVectorField) -> AbstractVectorField:
    """The field with the running batch-norm statistics of `source`."""

    def running(tree) -> list:
        nodes = jax.tree.leaves(tree, is_leaf=lambda node: isinstance(node, BatchNorm))
        return [node.running for node in nodes if isinstance(node, BatchNorm)]

    return eqx.tree_at(running, field, running(source))
