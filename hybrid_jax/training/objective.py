"""What a training run minimises and validates on, and the settings that its program is compiled for."""

from dataclasses import dataclass, field
from typing import Any, Protocol

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from hybrid_jax import checks, kernels
from hybrid_jax.dynamics.base import AbstractVectorField, as_field, state_space
from hybrid_jax.dynamics.batching import batch_norms
from hybrid_jax.dynamics.composition import Hybrid
from hybrid_jax.integrate import RK4, check_solver
from hybrid_jax.metrics import window_mse
from hybrid_jax.runtime import FAST_COMPILE
from hybrid_jax.training.loss import Minibatch, Regulariser, along, rollout_minibatch
from hybrid_jax.trajectories import Trajectories, check, errors_of, last_measured

FLOOR = 1e-3  # smallest scale of a state over its size: one that hardly changes must not outweigh the others

Learner = Any  # an Equinox module: a vector field, or anything that the objective can evaluate


class Objective(Protocol):
    """What `fit` minimises: a hashable object with a training and a validation loss. Subclass it to define your own."""

    def prepare(self, windows: Trajectories, name: str) -> PyTree:
        """Return the data of a run. They must have a length, and be indexed by arrays of integers.

        Args:
            windows: the training or validation data of `fit`.
            name: what messages call the windows, "train" or "validation".

        Raises:
            ValueError: if the windows are unusable.
        """

    def batch(self, picked: PyTree, settings: "Settings") -> PyTree:
        """Return a minibatch in the layout that `loss` needs; by default unchanged.

        Args:
            picked: the windows of the minibatch, indexed from the data of `prepare`.
            settings: of the compiled program.
        """
        return picked

    def loss(
        self, field: Learner, batch: PyTree, settings: "Settings", weight: Float[Array, ""]
    ) -> tuple[Float[Array, ""], PyTree]:
        """Return the loss on a minibatch, and the values that `observe` needs.

        Args:
            field: what is trained.
            batch: a minibatch, as returned by `batch`.
            settings: of the compiled program.
            weight: λ, the weight of the regulariser.
        """
        ...

    def observe(self, field: Learner, batch: PyTree, seen: PyTree) -> Learner:
        """Return the field with running statistics updated by the minibatch; by default the field itself.

        Args:
            field: what is trained.
            batch: a minibatch, as returned by `batch`.
            seen: the second value returned by `loss`.
        """
        return field

    def validate(self, field: Learner, data: PyTree, settings: "Settings") -> Float[Array, ""]:
        """Return the validation loss, for early stopping and the choice of the best epoch.

        Args:
            field: what is trained.
            data: the validation data, as returned by `prepare`.
            settings: of the compiled program.
        """
        ...


@dataclass(frozen=True)
class TrajectoryLoss(Objective):
    """The default loss (paper, Eq. 6): L_MSE = (1/T) Σ_t ‖x_t − x̂_t‖², averaged over windows; + λ L_reg in training.

    Attributes:
        scale: the error of each state (d) that counts as 1, in its unit, infinite for a state that does not count; by
            default each counts in its own unit. You should set it if units differ: without it, an error of 1 rad/s
            counts ten thousand times as much as 1 cm. See `scaled_loss`.

    Raises:
        ValueError: if a scale is not positive.
    """

    scale: tuple[float, ...] | None = None

    def __post_init__(self):
        given = self.scale
        if given is not None and not (isinstance(given, tuple) and all((checks.real(one) or 0) > 0 for one in given)):
            raise ValueError(f"scale must be a tuple of positive numbers, got {checks.short_repr(given)}")

    def prepare(self, windows: Trajectories, name: str) -> Trajectories:
        size = check(windows, name, missing=True).x.shape[-1]
        if self.scale is not None and size != len(self.scale):
            raise ValueError(f"{name}: states of {len(self.scale)} numbers expected, like scale, got {size}")
        return windows

    def batch(self, picked: Trajectories, settings: "Settings") -> Minibatch:
        last = (jnp.moveaxis(a, 0, -1) for a in (picked.x0, picked.u, picked.x))
        return Minibatch(*last, dt=picked.dt, solver=settings.solver)

    def loss(self, field: AbstractVectorField, batch: Minibatch, settings: "Settings", weight: Float[Array, ""]):
        predicted = rollout_minibatch(field, batch.x0, batch.u, batch.dt, batch.solver)
        errors = errors_of(predicted, batch.x)
        if (divisor := self.divisor()) is not None:
            errors = errors / divisor[:, None]
        value = jnp.mean(jnp.mean(jnp.sum(jnp.square(errors), axis=1), axis=0))
        if settings.regulariser is not None and isinstance(field, Hybrid):
            value = value + weight * settings.regulariser(field, batch, predicted)
        return value, predicted

    def divisor(self) -> Float[Array, " d"] | None:
        """Return `scale` as an array, in the current precision."""
        # By NumPy first, since JAX would compile a program for the conversion.
        return None if self.scale is None else jnp.asarray(np.asarray(self.scale, jnp.result_type(float)))

    def observe(self, field: AbstractVectorField, batch: Minibatch, seen: Float[Array, "t d b"]) -> AbstractVectorField:
        return as_field(field).update_running_stats(*along(batch.x0, seen, batch.u))

    def validate(self, field: AbstractVectorField, data: Trajectories, settings: "Settings") -> Float[Array, ""]:
        return jnp.mean(window_mse(field, data, solver=settings.solver, scale=self.divisor()))


def scaled_loss(field: AbstractVectorField, windows: Trajectories) -> TrajectoryLoss:
    """Return a loss relative to the RMS change over a window of each quantity in the field's state space."""
    x0, end = np.asarray(windows.x0, float), last_measured(windows)[:, -1].astype(float)

    def rms(vectors: Float[np.ndarray, "n k"]) -> float:
        return float(np.sqrt(np.mean(np.sum(np.square(vectors), axis=-1))))

    scale: list[float] = []
    for part, one in state_space(field, x0.shape[-1]).parts:
        changed, size = rms(end[:, part] - x0[:, part]), rms(end[:, part])
        scale += [max(changed, FLOOR * size) or 1.0] * one.size
    return TrajectoryLoss(tuple(scale))


UNSCALED = TrajectoryLoss()  # the default, which `adapt` replaces


@dataclass(frozen=True)
class Settings:
    """Settings of a training program, the same for all runs of a sweep.

    Attributes:
        batch_size: windows in a minibatch, or all if there are fewer. With only a hundred windows you should try 20.
        regulariser: L_reg, a function of a `Hybrid`, the minibatch and its predicted states; by default there is none.
        solver: the integrator from sample to sample, by default one step of RK4.
        objective: the training and validation loss, by default the squared error of trajectories; `adapt` divides it by
            the size of each state, see `scaled_loss`.

    Raises:
        ValueError: if the batch size, regulariser, solver or objective is invalid.
    """

    batch_size: int = 100
    regulariser: Regulariser | None = None
    solver: diffrax.AbstractSolver = field(default_factory=RK4)
    objective: Objective = UNSCALED

    def __post_init__(self):
        if self.regulariser is not None and not callable(self.regulariser):
            expected = "a function, such as one of hybrid_jax.training.loss.REGULARISERS"
            raise ValueError(f"regulariser must be {expected}, got {checks.short_repr(self.regulariser)}")
        checks.count("batch_size", self.batch_size)
        check_solver(self.solver)
        methods = (getattr(self.objective, name, None) for name in ("prepare", "batch", "loss", "observe", "validate"))
        if isinstance(self.objective, type) or not all(map(callable, methods)):
            raise ValueError(f"objective must be an Objective, got {checks.short_repr(self.objective)}")


def check_minibatch(field: Learner, settings: Settings) -> None:
    """Reject minibatches of one window if a BatchNorm is trained: minus its own mean, a window is a constant."""
    if settings.batch_size < 2 and batch_norms(field):
        size = settings.batch_size
        raise ValueError(f"settings.batch_size must be at least 2 if the field contains a BatchNorm, got {size}")


def compiler_options(field: Learner, data: PyTree, settings: Settings) -> dict[str, bool | int]:
    """Return XLA options for a training program: faster compilation if kernels do most of the work."""
    if not isinstance(data, Trajectories):
        return {}
    x0, u = (jax.ShapeDtypeStruct((settings.batch_size, *a.shape[1:]), a.dtype) for a in (data.x0, data.u))
    return FAST_COMPILE if kernels.serves_training(field, x0, u, settings.solver, windows_axis=0) else {}
