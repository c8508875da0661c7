"""Prediction models of the closed loop, trained or from the shared cache, and the true vehicle's model."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from experiments.closed_loop.flights import DOMAINS, ModelSet
from experiments.closed_loop.results import SOURCES, Agent
from experiments.paper import study
from experiments.paper.config import Config
from experiments.paper.lanes import Fit
from experiments.runner.stages import Stages
from hybrid_jax import rotation
from hybrid_jax.adaptation import Method
from hybrid_jax.dynamics.base import AbstractVectorField, as_field
from hybrid_jax.dynamics.rigid_body import RigidBody, nominal, rigid_body
from hybrid_jax.io import Dataset, portable
from hybrid_jax.sim.domain import SOURCE, Domain
from hybrid_jax.sim.forces import WIND_MEAN, drag, ground_effect, parameters_of, wind
from hybrid_jax.sweep.lanes import lane
from hybrid_jax.vehicle import IRIS, QUATERNION, VELOCITY, Input, State, Vehicle


@dataclass(frozen=True)
class Trained:
    """A model before and after adaptation, stacked over seeds; `adapted` by domain and N."""

    source: AbstractVectorField
    adapted: dict[tuple[str, int], AbstractVectorField]


def train(model: str, config: Config, stages: Stages) -> Trained:
    """Pre-train a model (an id in `experiments.paper.conditions`) and adapt it to each domain."""
    source = study.flown(SOURCE, study.source_splits(config), config, stages)
    start = study.pretrained(model, IRIS, config, stages, source).fields
    fit = partial(study.adapted, model, "fine_tuned", start, config, stages)
    return _adapt(start, config, stages, fit)


def least_squares(source: AbstractVectorField, method: Method, config: Config, stages: Stages) -> Trained:
    """Fit θ_p and a constant disturbance of the source models to the smallest N of each domain."""
    own = replace(config, sizes=(min(config.sizes),), pool=config.shared_pool())

    def fit(target: Dataset) -> Fit:
        return study.solved(f"least squares {target.config['domain']}", method, source, own, stages, target)

    return _adapt(source, own, stages, fit)


def _adapt(start: AbstractVectorField, config: Config, stages: Stages, fit: Callable[[Dataset], Fit]) -> Trained:
    found, seeds = {}, config.seeds
    for domain in DOMAINS:
        fields = fit(study.flown(domain, study.target_splits(config), config, stages)).fields
        for i, n in enumerate(config.sizes):
            found[domain.name, n] = lane(fields, np.arange(i * seeds, (i + 1) * seeds))
    return Trained(start, found)


def disturbance_counts(fitted: Trained) -> list[str]:
    fields: dict[tuple[str, int], Any] = {**fitted.adapted}
    found = {domain: np.any(field.physics.residual.value != 0, axis=1) for (domain, _), field in fields.items()}
    return [f"{domain}: {own.sum()} of {len(own)} seeds have a disturbance." for domain, own in found.items()]


def model_set(domain: Domain, trained: dict[str, Trained], sizes: Sequence[int]) -> ModelSet:
    """Return all models of a domain by agent, each also with an observer, and last the true vehicle.

    `trained` is by id in `results.LEARNED`; `sizes` begins with the smallest N, or is empty for the unchanged vehicle.
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
    return jax.device_get(eqx.filter_jit(eqx.filter_vmap(lambda field: as_field(field).fuse_for_inference()))(fields))


def as_stack(field: Any) -> Any:
    return jax.tree.map(lambda leaf: np.asarray(leaf)[None], field)


@portable
class TrueField(AbstractVectorField):
    """ẋ = f_p(x, u) + (drag, ground effect, a constant force)."""

    body: RigidBody  # f_p
    drag: Float[Array, ""]  # coefficient [kg/s]
    push: Float[Array, "3"]  # constant force [N, world]

    def __call__(self, x: State, u: Input) -> State:
        vehicle, theta = self.body.vehicle, self.body.theta()
        known = eqx.tree_at(lambda p: p.drag_coefficient, parameters_of(vehicle), self.drag)
        now = jnp.zeros((), x.dtype)  # neither force depends on time
        air, ground = drag(x, u, now, known), ground_effect(x, u, now, known)
        torque = rotation.rotate(rotation.conjugate(x[QUATERNION]), ground.torque)
        inertia = jnp.stack([theta["Ix"], theta["Iy"], jnp.asarray(vehicle.inertia[2], x.dtype)])
        force = air.force + ground.force + self.push
        still = jnp.zeros_like(x, shape=VELOCITY.start)
        return self.body(x, u) + jnp.concatenate([still, force / vehicle.mass, torque / inertia])


def true_field(domain: Domain, vehicle: Vehicle) -> TrueField:
    """Return a domain's true vehicle with its forces and the mean wind; `vehicle` is the models' vehicle."""
    truth = nominal(domain.vehicle)
    body = RigidBody({name: jnp.log(truth[name] / value) for name, value in nominal(vehicle).items()}, vehicle)
    push = jnp.array([0.0, WIND_MEAN if wind in domain.forces else 0.0, 0.0])
    return TrueField(body, jnp.asarray(domain.drag_coefficient), push)
