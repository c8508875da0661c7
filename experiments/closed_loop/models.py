"""What flies: every model of the closed loop, trained or known, by who it is; all stages come from the shared cache."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import equinox as eqx
import jax
import numpy as np
from rich.console import Console

from experiments.closed_loop.common_field import Believed, CommonField, common, true_field
from experiments.closed_loop.rows import SOURCES, Flyer
from experiments.paper.conditions import input_scaling
from experiments.paper.config import Config
from experiments.paper.solved import Solve, solved
from experiments.paper.study import adapted, flown, places, pretrained, source_splits, target_splits
from experiments.runner.stages import Stages, stages_of
from hybrid_jax.dynamics.base import AbstractVectorField
from hybrid_jax.dynamics.rigid_body import rigid_body
from hybrid_jax.networks.mlp import InputScaling
from hybrid_jax.networks.normalisation import BatchNorm
from hybrid_jax.sim.domain import SOURCE, Domain
from hybrid_jax.sweep.lanes import lane
from hybrid_jax.vehicle import Vehicle


@dataclass(frozen=True)
class Trained:
    """A model before and after adaptation, one lane a seed; `adapted` by domain and N."""

    source: AbstractVectorField
    adapted: dict[tuple[str, int], AbstractVectorField]


def train(
    name: str, model: str, vehicle: Vehicle, config: Config, console: Console, domains: Sequence[Domain]
) -> tuple[Trained, Stages]:
    """Pre-train a model and adapt it to each domain.

    Args:
        name: of the stages, for people.
        model: what `experiments.paper.conditions` calls it.
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


def nine_numbers(
    source: AbstractVectorField, few: int, solve: Solve, config: Config, console: Console, domains: Sequence[Domain]
) -> tuple[Trained, Stages]:
    """Hybrids of the source, of which θ_p and a constant disturbance are fitted to each domain by least squares.

    Args:
        solve: `needed_disturbance` or `constant_disturbance`.
    """
    stages, own = stages_of(config, console), replace(config, sizes=(few,))

    def of(domain: Domain) -> AbstractVectorField:
        target = flown(domain, target_splits(config), config, stages)
        return solved(f"least squares {domain.name}", solve, source, own, stages, target).fields

    return Trained(source, {(domain.name, few): of(domain) for domain in domains}), stages


def disturbed_seeds(nine: Trained) -> list[str]:
    """How many seeds of each domain have a constant disturbance, in words."""
    fields: dict[tuple[str, int], Any] = {**nine.adapted}
    pushes = {domain: field.physics.residual.value for (domain, _), field in fields.items()}
    counts = {domain: np.any(np.asarray(push) != 0, axis=1) for domain, push in pushes.items()}
    return [f"{domain}: {found.sum()} of {len(found)} seeds have a disturbance." for domain, found in counts.items()]


def fleet(
    domain: Domain, vehicle: Vehicle, trained: dict[str, Trained], few: int, many: int, config: Config
) -> dict[Flyer, Believed]:
    """All that flies in a domain: a lane for each seed, or one of a model that was not trained.

    Args:
        trained: "physics", "hybrid", "no_physics", "safe", "nine".
    """
    fields: dict[Flyer, Any] = {Flyer("nominal"): single(rigid_body(vehicle))}
    for model, found in trained.items():
        if model in ("hybrid", "safe"):
            fields[Flyer(model)] = found.source
        sizes = (few,) if model in ("physics", "nine") else dict.fromkeys((few, many))
        fields |= {Flyer(model, size): found.adapted[domain.name, size] for size in sizes}
    adapted = [Flyer(model, few) for model in SOURCES]
    return _crew(domain, vehicle, fields, [Flyer("nominal"), *_sources(), *adapted], config)


def unchanged_fleet(vehicle: Vehicle, trained: dict[str, Trained], config: Config) -> dict[Flyer, Believed]:
    """All that flies the vehicle of the source, which has not changed: what was not adapted.

    Args:
        trained: as of `fleet`.
    """
    fields = {Flyer("nominal"): single(rigid_body(vehicle))}
    fields |= {flyer: trained[flyer.model].source for flyer in _sources()}
    return _crew(SOURCE, vehicle, fields, list(fields), config)


def _sources() -> list[Flyer]:
    """The hybrids before adaptation."""
    return [Flyer(model) for model in dict.fromkeys(SOURCES.values())]


def _crew(
    domain: Domain, vehicle: Vehicle, fields: dict[Flyer, Any], observed: Sequence[Flyer], config: Config
) -> dict[Flyer, Believed]:
    """These fields, those `observed` with an observer as well, and the true one."""
    models = {flyer: in_common(field, vehicle, config) for flyer, field in fields.items()}
    models |= {replace(flyer, observer=True): models[flyer] for flyer in observed}
    return models | {Flyer("oracle"): single(true_field(domain, vehicle))}


def in_common(fields: AbstractVectorField, vehicle: Vehicle, config: Config) -> CommonField:
    """Stacked fields as stacked lanes of the common form."""
    return jax.device_get(_in_common(fields, vehicle, config.hidden, input_scaling(vehicle, config)))


@eqx.filter_jit
def _in_common(fields, vehicle: Vehicle, hidden: int, scaling: InputScaling) -> CommonField:
    return eqx.filter_vmap(lambda field: common(field, vehicle, hidden, scaling))(fields)


def single(field: Any) -> Any:
    """One field as a stack of one."""
    return jax.tree.map(lambda leaf: np.asarray(leaf)[None], field)


def with_statistics_of(source: AbstractVectorField, field: AbstractVectorField) -> AbstractVectorField:
    """The field with the running statistics of batch normalisation of another one: the trap of the wrong domain."""

    def norms(tree) -> list[BatchNorm]:
        nodes = jax.tree.leaves(tree, is_leaf=lambda node: isinstance(node, BatchNorm))
        return [node for node in nodes if isinstance(node, BatchNorm)]

    return eqx.tree_at(
        lambda tree: [norm.running for norm in norms(tree)], field, [norm.running for norm in norms(source)]
    )
