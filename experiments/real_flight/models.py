"""The models of a real vehicle before training."""

from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import PRNGKeyArray

from experiments.real_flight.recipes import Recipe
from hybrid_jax.dynamics.base import AbstractVectorField, Hybrid
from hybrid_jax.dynamics.baselines import FrozenRates
from hybrid_jax.dynamics.kinematics import Kinematics
from hybrid_jax.dynamics.multirotor import Multirotor, multirotor, with_vehicle
from hybrid_jax.dynamics.vehicle_file import VehicleModel
from hybrid_jax.networks.factory import make_residual
from hybrid_jax.networks.mlp import InputScaling, zero_output
from hybrid_jax.training.channels import ChannelLoss, channels_from
from hybrid_jax.trajectories import Trajectories
from hybrid_jax.vehicle import Vehicle

NETWORK, ORDER = range(2)  # uses of a seed: weights of the network, order of the minibatches


def rigid_body_of(model: VehicleModel) -> Multirotor:
    """The vehicle at its nominal values, with nothing to learn."""
    return multirotor(model.vehicle, (), model.terms)


def thrust_baseline(model: VehicleModel) -> AbstractVectorField:
    """Nominal thrust with frozen body rates: the baseline that errors are compared with."""
    return FrozenRates(rigid_body_of(model))


def physics_of(model: VehicleModel, recipe: Recipe) -> AbstractVectorField:
    """f_p of a recipe at its nominal values."""
    off = recipe.physics == "torque_off"
    terms = replace(model.terms, torque_gain=(0.0, 0.0, 0.0)) if off else model.terms
    body = multirotor(model.vehicle, recipe.learn or model.learn, terms)
    return FrozenRates(body) if recipe.physics == "frozen_rates" else body


def untrained(name: str, model: VehicleModel, recipe: Recipe, hidden: int, seeds: int) -> AbstractVectorField:
    """Stack the untrained fields of all seeds; an untrained hybrid equals its physics."""
    hover = InputScaling(model.vehicle.hover_speed, model.vehicle.hover_speed / 10)
    physics = physics_of(model, recipe)
    # Without physics, no other term could reconcile an estimator's position with its velocity.
    outputs = "motion" if name == "no_physics" else recipe.outputs
    options: dict[str, Any] = {"inputs": "body_motion", "outputs": outputs, "norm": "none", "scaling": hover}

    def build(seed):
        if name == "physics_only":
            return physics
        network = zero_output(make_residual(key_of(seed, NETWORK), hidden=hidden, **options))
        return Hybrid(Kinematics() if name == "no_physics" else physics, network)

    return jax.device_get(eqx.filter_jit(eqx.filter_vmap(build))(np.arange(seeds)))


def move_to_vehicle(fields: Any, vehicle: Vehicle) -> Any:
    """Move stacked fields to another vehicle, such as one with a payload; θ_p keeps its values in SI units."""

    def one(field):
        return jax.tree.map(lambda node: with_vehicle(node, vehicle) if is_body(node) else node, field, is_leaf=is_body)

    return jax.device_get(eqx.filter_jit(eqx.filter_vmap(one))(fields))


def is_body(node: Any) -> bool:
    """Whether a node of a field's tree is a multirotor."""
    return isinstance(node, Multirotor)


def objective_of(model: VehicleModel, windows: Trajectories, recipe: Recipe) -> ChannelLoss:
    """Scale each channel of the loss by the error of the thrust baseline at the end of the training windows."""
    position, *others = channels_from(thrust_baseline(model), windows)  # in the state's order
    position = replace(position, scale=recipe.position * position.scale)
    return ChannelLoss((position, *others), recipe.huber)


def key_of(seed, purpose: int) -> PRNGKeyArray:
    """The key of one use of a seed."""
    return jax.random.fold_in(jax.random.key(seed), purpose)
