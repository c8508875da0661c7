"""The models of a real vehicle before training, and the recipes that train them: stages as data."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal

import equinox as eqx
import jax
import numpy as np

from hybrid_jax.dynamics.base import AbstractVectorField, trainable
from hybrid_jax.dynamics.baselines import FrozenRates, Kinematics
from hybrid_jax.dynamics.composition import Hybrid
from hybrid_jax.dynamics.rigid_body import RigidBody, rigid_body, with_vehicle
from hybrid_jax.dynamics.vehicle_file import VehicleModel
from hybrid_jax.io.archive import named_leaves
from hybrid_jax.networks.factory import make_residual
from hybrid_jax.networks.mlp import InputScaling, zero_output
from hybrid_jax.training.channels import ChannelLoss, channels_from
from hybrid_jax.trajectories import Trajectories
from hybrid_jax.vehicle import Vehicle

Model = Literal["hybrid", "no_physics", "physics_only"]

REFERENCE = 1000  # N for which a recipe states the epochs of an adaptation
NETWORK, ORDER = range(2)  # uses of a seed: weights of the network, order of the minibatches
NETWORK_ALONE = 5e-3  # rate of a network without physics in stages that train physics alone


@dataclass(frozen=True)
class Step:
    """One stage of training, as `hybrid_jax.training.stages.Stage`."""

    physics: float  # Adam's learning rate; 0 freezes that part
    residual: float
    steps: int  # the first intervals of each window
    epochs: int
    patience: int = 20
    frozen: tuple[str, ...] = ()  # names of physical parameters that are not trained


@dataclass(frozen=True)
class Recipe:
    """A way to train every model."""

    about: str  # for the report
    window: int  # intervals per window, for training and validation
    source: tuple[Step, ...]  # stages on the source's flights
    adaptation: tuple[Step, ...]  # stages on N windows of the target, from the source's model
    scratch: tuple[Step, ...]  # the same from the nominal vehicle
    physics: Literal["multirotor", "torque_off", "frozen_rates"] = "multirotor"  # of the hybrid and of physics-only
    learn: tuple[str, ...] = ()  # names of `multirotor.SHAPES`; if empty, those of the vehicle
    outputs: Literal["accelerations", "angular_acceleration", "motion"] = "motion"  # of a hybrid's network
    # Factor on the scale of position errors in the loss. Position is the integral of velocity and adds no information;
    # where an estimator's two disagree, a smaller scale would cause wrong accelerations.
    position: float = 1.0
    huber: float = 1.0  # errors above this multiple of the baseline's error count linearly


_SOURCE = (Step(2e-2, 0, 10, 20), Step(5e-3, 5e-3, 10, 30), Step(1e-3, 2e-3, 25, 20), Step(3e-4, 5e-4, 25, 10))
# The gain of the velocity estimate is a property of the estimator, which no change of the vehicle affects. So is its
# lag, but flights after the change determine that single number better than the source does.
_ESTIMATOR = ("velocity_gain",)
# A load on a cable comes with the change; fitted to flights without one, the pull would absorb aerodynamic moments.
CHANGE = ("cable_pull",)
_ADAPTATION = (
    Step(1e-2, 0, 10, 80, 30, _ESTIMATOR),
    Step(3e-3, 3e-3, 10, 80, 30, _ESTIMATOR),
    Step(1e-3, 1e-3, 25, 60, 20, _ESTIMATOR),
)
_SCRATCH = (Step(2e-2, 0, 10, 120, 40), Step(5e-3, 5e-3, 10, 160, 40), Step(1e-3, 1e-3, 25, 60, 20))
# For manoeuvres other than those trained on: short training limits overfitting of the rotation, while thrust and drag,
# which transfer to all manoeuvres, are identified within a few steps.
_BRIEF = (Step(2e-2, 0, 10, 20), Step(0, 2e-3, 25, 5), Step(0, 1e-3, 50, 5))

_STAGED = Recipe(
    "physics, then all on 10 steps, then all on 25; the network adds to accelerations alone",
    *(25, _SOURCE, _ADAPTATION, _SCRATCH), outputs="accelerations", position=10.0,
)  # fmt: skip
_TURNING = "physics, then all on 10 steps, then all on 25; the network adds to the angular acceleration alone"
_SHORT = "physics, then all on 10 steps; the network adds to accelerations alone"
_CAREFUL = Recipe(
    "physics on 10 steps, then the network alone for a few epochs on 25 and 50; it adds to the angular acceleration",
    *(50, _BRIEF, _BRIEF, _BRIEF),
    outputs="angular_acceleration",
    position=10.0,
    # Where one manoeuvre is far more aggressive than the others, squared errors of it would dominate the loss.
    huber=0.2,
)

RECIPES: Mapping[str, Recipe] = {
    "staged": _STAGED,
    "turning": replace(_STAGED, about=_TURNING, outputs="angular_acceleration"),
    "short": replace(_STAGED, about=_SHORT, source=_SOURCE[:2], adaptation=_ADAPTATION[:2], scratch=_SCRATCH[:2]),
    "torque_off": replace(
        _CAREFUL,
        about=f"the rotors' torque is not used; {_CAREFUL.about}",
        physics="torque_off",
        learn=("k", "drag", "aerodynamic_moment", "rate_damping", "velocity_gain"),
    ),
    "frozen_rates": replace(
        _CAREFUL,
        about=f"of physics thrust and drag alone; {_CAREFUL.about}",
        physics="frozen_rates",
        learn=("k", "drag", "velocity_gain"),
    ),
}

if TYPE_CHECKING:
    RecipeName = str
else:
    RecipeName = Literal[tuple(RECIPES)]


def rates_of(step: Step, model: str, field: AbstractVectorField) -> dict[str, float]:
    """The learning rate of each group of a field's parameters; 0 for those that the step freezes."""
    rates = {
        "hybrid": {"physics": step.physics, "residual": step.residual},
        # It has no physics to train first, and gets as many epochs.
        "no_physics": {"residual": step.residual or NETWORK_ALONE},
        "physics_only": {"": step.physics},
    }
    paths = named_leaves(eqx.filter(field, trainable(field)))
    return rates[model] | {path: 0.0 for path in paths if path.rpartition("/")[-1] in step.frozen}


def equivalent_recipe(model: str, recipe: str, among: Sequence[str]) -> str:
    """The first of some recipes that trains a model in the same way; only a hybrid depends on `outputs`."""

    def training(name: str) -> Recipe:
        how = replace(RECIPES[name], about="")
        return how if model == "hybrid" else replace(how, outputs="motion")

    return next((name for name in among if training(name) == training(recipe)), recipe)


def thrust_baseline(model: VehicleModel) -> AbstractVectorField:
    """Nominal thrust with frozen body rates: the baseline that errors are compared with."""
    return FrozenRates(rigid_body(model.vehicle, (), model.terms))


def physics_of(model: VehicleModel, recipe: Recipe) -> AbstractVectorField:
    """f_p of a recipe at its nominal values."""
    terms = model.terms
    if recipe.physics == "torque_off":
        terms = replace(terms, torque_gain=(0.0, 0.0, 0.0))
    body = rigid_body(model.vehicle, recipe.learn or model.learn, terms)
    return FrozenRates(body) if recipe.physics == "frozen_rates" else body


def untrained(
    name: str, model: VehicleModel, recipe: Recipe, hidden: int, seeds: int, activation: str = "relu"
) -> AbstractVectorField:
    """Stack the untrained fields of all seeds; an untrained hybrid equals its physics."""
    hover = InputScaling(model.vehicle.hover_speed, model.vehicle.hover_speed / 10)
    physics = physics_of(model, recipe)
    # Without physics, no other term could reconcile an estimator's position with its velocity.
    outputs = "motion" if name == "no_physics" else recipe.outputs
    options: dict[str, Any] = {"inputs": "body_motion", "outputs": outputs, "norm": "none", "scaling": hover}

    def build(seed):
        if name == "physics_only":
            return physics
        key = jax.random.fold_in(jax.random.key(seed), NETWORK)
        network = zero_output(make_residual(key, hidden=hidden, activation=activation, **options))
        return Hybrid(Kinematics() if name == "no_physics" else physics, network)

    return jax.device_get(eqx.filter_jit(eqx.filter_vmap(build))(np.arange(seeds)))


def move_to_vehicle(fields: Any, vehicle: Vehicle) -> Any:
    """Move stacked fields to another vehicle, such as one with a payload; θ_p keeps its values in SI units."""

    def move(node):
        return with_vehicle(node, vehicle) if _is_body(node) else node

    moved = eqx.filter_vmap(lambda field: jax.tree.map(move, field, is_leaf=_is_body))
    return jax.device_get(eqx.filter_jit(moved)(fields))


def body_of(field: Any) -> Any:
    """The multirotor inside a field, which holds all that its physics learns; None without one."""
    return next(filter(_is_body, jax.tree.leaves(field, is_leaf=_is_body)), None)


def _is_body(node: Any) -> bool:
    return isinstance(node, RigidBody)


def objective_of(model: VehicleModel, windows: Trajectories, recipe: Recipe) -> ChannelLoss:
    """Scale each channel of the loss by the error of the thrust baseline at the end of the training windows."""
    position, *others = channels_from(thrust_baseline(model), windows)  # in the state's order
    position = replace(position, scale=recipe.position * position.scale)
    return ChannelLoss((position, *others), recipe.huber)
