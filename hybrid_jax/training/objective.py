"""What a training run minimises, and on what it is judged: by default how well a field predicts trajectories."""

from dataclasses import dataclass, field
from typing import Any, Protocol

import diffrax
from jaxtyping import Array, Float, PyTree

from hybrid_jax import checks
from hybrid_jax.dynamics.base import AbstractVectorField, update_running_stats
from hybrid_jax.integrate import RK4, along, rollout_minibatch
from hybrid_jax.metrics import rollout_mse
from hybrid_jax.training.loss import Minibatch, Regulariser, loss, minibatch
from hybrid_jax.trajectories import Trajectories, check

Learner = Any  # an Equinox module: a vector field, or whatever the objective at hand can evaluate


class Objective(Protocol):
    """Turns windows into a number to descend on, and one to judge an epoch by. A value that can be hashed."""

    def prepare(self, windows: Trajectories, name: str) -> PyTree:
        """The data of a run, once, before it begins: anything with a length that an array of indices picks from.

        Raises:
            ValueError: windows of which nothing can be learned; `name` is what they are called.
        """
        ...

    def batch(self, picked: PyTree, settings: "Settings") -> PyTree:
        """A minibatch in the layout in which `loss` wants it."""
        ...

    def loss(
        self, field: Learner, batch: PyTree, settings: "Settings", weight: Float[Array, ""]
    ) -> tuple[Float[Array, ""], PyTree]:
        """The loss on a minibatch, and what was seen on the way."""
        ...

    def observe(self, field: Learner, batch: PyTree, seen: PyTree) -> Learner:
        """The field after it has seen the minibatch: running statistics move, learned parameters do not."""
        ...

    def validate(self, field: Learner, data: PyTree, settings: "Settings") -> Float[Array, ""]:
        """What early stopping and the choice of the best epoch go by; less is better."""
        ...


@dataclass(frozen=True)
class TrajectoryLoss:
    """L_MSE + λ L_reg of the predicted trajectories of a vector field (paper, Sec. 3.3); judged by L_MSE alone."""

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
    """What is the same for all lanes of a sweep and fixed when it is compiled.

    Raises:
        ValueError: a regulariser that is no function, such as the name of one.
    """

    batch_size: int = 100
    regulariser: Regulariser | None = None
    solver: diffrax.AbstractSolver = field(default_factory=RK4)
    objective: Objective = TrajectoryLoss()

    def __post_init__(self):
        if self.regulariser is not None and not callable(self.regulariser):
            said = checks.short_repr(self.regulariser)
            raise ValueError(
                f"regulariser must be a function, such as one of hybrid_jax.training.loss.REGULARISERS, got {said}"
            )
