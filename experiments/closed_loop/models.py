"""Train or load every prediction model of the closed loop; all stages come from the shared cache."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import equinox as eqx
import jax
import numpy as np

from experiments.closed_loop.rows import SOURCES, Agent
from experiments.closed_loop.scenarios import DOMAINS, ModelSet
from experiments.closed_loop.true_model import true_field
from experiments.paper.config import Config
from experiments.paper.study import adapted, flown, places, pretrained, solved, source_splits, target_splits
from experiments.runner.stages import Stages
from hybrid_jax.adaptation import Method
from hybrid_jax.dynamics.base import AbstractVectorField, fuse_for_inference
from hybrid_jax.dynamics.rigid_body import rigid_body
from hybrid_jax.networks.normalisation import BatchNorm
from hybrid_jax.sim.domain import SOURCE, Domain
from hybrid_jax.sweep.lanes import lane
from hybrid_jax.vehicle import IRIS


@dataclass(frozen=True)
class Trained:
    """A model before and after adaptation, stacked over seeds; `adapted` by domain and N."""

    source: AbstractVectorField
    adapted: dict[tuple[str, int], AbstractVectorField]


def train(model: str, config: Config, stages: Stages) -> Trained:
    """Pre-train a model (an id in `experiments.paper.conditions`) and adapt it to each domain."""
    start = pretrained(model, IRIS, config, stages, flown(SOURCE, source_splits(config), config, stages)).fields
    sizes, _ = places(config.sizes, config)
    found = {}
    for domain in DOMAINS:
        target = flown(domain, target_splits(config), config, stages)
        final = adapted(model, "fine_tuned", start, config, stages, target).fields
        for size in config.sizes:
            found[domain.name, size] = lane(final, np.flatnonzero(np.equal(sizes, size)))
    return Trained(start, found)


def least_squares(source: AbstractVectorField, method: Method, config: Config, stages: Stages) -> Trained:
    """Fit θ_p and a constant disturbance of the source models to the smallest N of each domain by least squares."""
    own = replace(config, sizes=(min(config.sizes),))
    found = {}
    for domain in DOMAINS:
        target = flown(domain, target_splits(config), config, stages)
        fit = solved(f"least squares {domain.name}", method, source, own, stages, target)
        found[domain.name, *own.sizes] = fit.fields
    return Trained(source, found)


def disturbance_counts(fitted: Trained) -> list[str]:
    """For each domain a sentence on how many seeds have a constant disturbance."""
    fields: dict[tuple[str, int], Any] = {**fitted.adapted}
    found = {domain: np.any(field.physics.residual.value != 0, axis=1) for (domain, _), field in fields.items()}
    return [f"{domain}: {own.sum()} of {len(own)} seeds have a disturbance." for domain, own in found.items()]


def model_set(domain: Domain, trained: dict[str, Trained], sizes: Sequence[int]) -> ModelSet:
    """All models that fly in a domain, by agent: with each model its observed version, and last the true vehicle.

    Args:
        trained: by id in `rows.LEARNED`.
        sizes: numbers of target trajectories, the smallest first; none for the vehicle before the change.
    """
    fields: dict[Agent, Any] = {Agent("nominal"): as_stack(rigid_body(IRIS))}
    for model, found in trained.items():
        if model in SOURCES.values():
            fields[Agent(model)] = found.source
        own = sizes[:1] if model in ("physics", "least_squares") else sizes
        fields |= {Agent(model, size): found.adapted[domain.name, size] for size in own}
    models = {agent: fused(field) for agent, field in fields.items()}
    few = [agent for agent in models if agent.model in ("nominal", *SOURCES) and agent.n_train in (0, *sizes[:1])]
    for agent in sorted(few, key=lambda agent: agent.n_train):
        models[replace(agent, observer=True)] = models[agent]
    return models | {Agent("oracle"): as_stack(true_field(domain, IRIS))}


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
