"""What a training run minimises and validates on, and the checks before it begins."""

from dataclasses import dataclass, field
from typing import Any, Protocol

import diffrax
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray, PyTree

from hybrid_jax import checks
from hybrid_jax.dynamics.base import AbstractVectorField, Frozen, check_batch_norm, trainable, update_running_stats
from hybrid_jax.dynamics.rigid_body import moves_a_rigid_body
from hybrid_jax.integrate import RK4, along, checked, rollout_minibatch
from hybrid_jax.metrics import rollout_mse
from hybrid_jax.networks.normalisation import BatchNorm
from hybrid_jax.training.loss import Minibatch, Regulariser, loss, minibatch
from hybrid_jax.trajectories import Trajectories, check, check_attitudes

Learner = Any  # an Equinox module: a vector field, or anything that the objective can evaluate


class Objective(Protocol):
    """Maps windows to a training loss and a validation loss. It must be hashable."""

    def prepare(self, windows: Trajectories, name: str) -> PyTree:
        """The data of a run: anything with a length that can be indexed by an array of integers. Called once.

        Raises:
            ValueError: windows that cannot be used; `name` is the argument's name.
        """
        ...

    def batch(self, picked: PyTree, settings: "Settings") -> PyTree:
        """A minibatch in the layout that `loss` needs."""
        ...

    def loss(
        self, field: Learner, batch: PyTree, settings: "Settings", weight: Float[Array, ""]
    ) -> tuple[Float[Array, ""], PyTree]:
        """The loss on a minibatch, and what `observe` needs of the evaluation."""
        ...

    def observe(self, field: Learner, batch: PyTree, seen: PyTree) -> Learner:
        """The field with its running statistics updated by the minibatch; learned parameters stay as they are."""
        ...

    def validate(self, field: Learner, data: PyTree, settings: "Settings") -> Float[Array, ""]:
        """The validation loss, which early stopping and the choice of the best epoch use."""
        ...


@dataclass(frozen=True)
class TrajectoryLoss:
    """L_MSE + λ L_reg of predicted trajectories (paper, Sec. 3.3). Validation uses L_MSE alone."""

    def prepare(self, windows: Trajectories, name: str) -> Trajectories:
        return check(windows, name)

    def batch(self, picked: Trajectories, settings: "Settings") -> Minibatch:
        return minibatch(picked, settings.solver)

    def loss(self, field: AbstractVectorField, batch: Minibatch, settings: "Settings", weight: Float[Array, ""]):
        predicted = rollout_minibatch(field, batch.x0, batch.u, batch.dt, batch.solver)
        return loss(field, batch, predicted, settings.regulariser, weight), predicted

    def observe(self, field: AbstractVectorField, batch: Minibatch, seen: Float[Array, "t d b"]) -> AbstractVectorField:
        x, u = along(batch.x0, seen, batch.u)
        return update_running_stats(field, x, u)

    def validate(self, field: AbstractVectorField, data: Trajectories, settings: "Settings") -> Float[Array, ""]:
        return rollout_mse(field, data, solver=settings.solver)


@dataclass(frozen=True)
class Settings:
    """What a training program is compiled for; the same for all runs of a sweep.

    Raises:
        ValueError: a regulariser that is not a function, such as the name of one.
    """

    batch_size: int = 100
    regulariser: Regulariser | None = None
    solver: diffrax.AbstractSolver = field(default_factory=RK4)
    objective: Objective = TrajectoryLoss()

    def __post_init__(self):
        if self.regulariser is not None and not callable(self.regulariser):
            got = checks.short_repr(self.regulariser)
            raise ValueError(
                f"regulariser must be a function, such as one of hybrid_jax.training.loss.REGULARISERS, got {got}"
            )


def prepared(
    field: Learner, train: Trajectories, validation: Trajectories, key: PRNGKeyArray, settings: Settings
) -> tuple[PyTree, PyTree]:
    """Both sets of windows as prepared by the objective, after all checks of what a run is given.

    Raises:
        ValueError: windows that the objective refuses, that do not match the field, or are of a rigid body and have no
            unit quaternions; fewer windows than a minibatch; a minibatch that `check_minibatch` refuses; a field with
            nothing to learn; or no random key.
    """
    data = settings.objective.prepare(train, "train")
    validated_on = settings.objective.prepare(validation, "validation")
    _check_learns(field)
    for name, windows in (("train", train), ("validation", validation)):
        _check_match(field, windows, name, settings)
    if isinstance(field, AbstractVectorField):
        check_batch_norm(field, jnp.asarray(train.x0[:2]).T, jnp.asarray(train.u[:2, 0]).T)
    checks.key("key", key)
    checks.count("settings.batch_size", settings.batch_size)
    check_minibatch(field, settings)
    if len(data) < settings.batch_size:
        raise ValueError(f"train has {len(data)} windows, fewer than batch_size={settings.batch_size}")
    return data, validated_on


def check_minibatch(field: Learner, settings: Settings) -> None:
    """Refuse minibatches of one window where a BatchNorm is trained: minus its own mean, a window is a constant.

    Raises:
        ValueError: the field learns through a BatchNorm, and the minibatch is smaller than 2.
    """
    nodes = jax.tree.leaves(field, is_leaf=lambda node: isinstance(node, Frozen | BatchNorm))
    if settings.batch_size < 2 and any(isinstance(node, BatchNorm) for node in nodes):
        raise ValueError(
            f"settings.batch_size must be at least 2 where the field holds a BatchNorm, got {settings.batch_size}"
        )


def _check_learns(field: Learner) -> None:
    if not any(jax.tree.leaves(trainable(field))):
        raise ValueError(
            f"field: {type(field).__name__} has nothing to learn, no array of floating-point numbers; a Python float "
            "is none, use jnp.asarray"
        )


def _check_match(field: Learner, windows: Trajectories, name: str, settings: Settings) -> None:
    """Refuse windows that do not match a vector field. Other learners are checked by their objective."""
    if isinstance(field, AbstractVectorField):
        try:
            x0, _, _ = checked(field, windows.x0, windows.u, windows.dt, settings.solver, windows=True)
        except ValueError as error:
            raise ValueError(f"{name}: {error}") from error
        if x0.dtype != jnp.result_type(windows.x0):
            raise ValueError(f"{name}: x0 must be {x0.dtype}, the precision of the field, got {windows.x0.dtype}")
    if moves_a_rigid_body(field):
        check_attitudes(windows, name)
