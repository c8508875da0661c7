"""Vector fields ẋ = f(x, u) of one state x (d,) and one input u (m,): physics, a network, or any function."""

from abc import abstractmethod
from collections.abc import Callable, Iterator
from typing import Any, ClassVar, Self, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from hybrid_jax.dynamics import batching
from hybrid_jax.dynamics.batching import AbstractInferenceOnly, Batch, RunningStats, batch_norms
from hybrid_jax.state_space import StateSpace
from hybrid_jax.trajectories import Trajectories

Learned = TypeVar("Learned")
Columns = Float[Array, "d c"]  # derivatives of d numbers in c directions


class AbstractVectorField(eqx.Module):
    """A vector field ẋ = f(x, u). Every inexact array inside is learned (see `trainable`).

    You should write `__call__` for one sample. The other methods evaluate a batch, features first: x (d, b), u (m, b).
    Their defaults work for any field; you can override those that you can make faster.

    Attributes:
        accepts_batch: whether `__call__` also accepts x (d, b) and u (m, b), for example if it only reads x[0], x[1], …
    """

    accepts_batch: ClassVar[bool] = False

    @abstractmethod
    def __call__(self, x: Float[Array, " d"], u: Float[Array, " m"]) -> Float[Array, " d"]:
        """Return ẋ of one sample, in inference mode."""

    def train_batch(self, x: Batch, u: Float[Array, "m b"]) -> Batch:
        """Evaluate ẋ on a minibatch in training mode: batch normalisation uses the moments of this minibatch."""
        direct = self.features_first and not batch_norms(self)
        return self(x, u) if direct else batching.over_samples(batching.training_mode(self))(x, u)

    def infer_batch(self, x: Batch, u: Float[Array, "m b"]) -> Batch:
        """Evaluate ẋ on a batch in inference mode, with one column for each sample."""
        return self(x, u) if self.features_first else batching.over_samples(self)(x, u)

    def update_running_stats(self, x: Batch, u: Float[Array, "m b"]) -> Self:
        """Return the field with running statistics updated by a minibatch; learned parameters do not change."""
        return batching.with_moved_stats(self, x, u)

    def apply_residual(self, x: Float[Array, " d *b"], residual: Float[Array, " d *b"]) -> Float[Array, " d *b"]:
        """Return what a residual adds to ẋ of this physics; by default the residual itself.

        Args:
            residual: the output (d,) of a network, in units of ẋ.
        """
        return residual

    def linearize(self, x: Float[Array, " d"], u: Float[Array, " m"], dx: Columns, du: Columns):
        """Return ẋ of one sample in inference mode, and its derivatives (d, c) along c directions.

        Args:
            dx: directions (d, c) of the state, in columns.
            du: directions (m, c) of the input, in columns.
        """
        return jvp_columns(self, (x, u), (dx, du))

    def parameter_columns(self, x: Float[Array, " d"], u: Float[Array, " m"]) -> Columns:
        """Return the derivative (d, p) of ẋ of one sample with respect to p learned numbers."""
        theta, at = ravel_learned(self)
        return jax.jacfwd(lambda theta: at(theta)(x, u))(theta)

    def fuse_for_inference(self) -> "AbstractVectorField":
        """Return the same map in inference mode, in a layout that is faster for few samples at a time."""
        return self

    @property
    def features_first(self) -> bool:
        """Whether a part of the field evaluates batches, so that the batch should be the last axis."""
        return self.accepts_batch

    @property
    def hidden(self) -> int:
        """The number of states that are not measured, which follow all others; by default 0."""
        return 0

    @property
    def state_space(self) -> StateSpace:
        """The state space; by default taken from the first field inside that has one, else empty."""
        spaces = (part.state_space for part in _fields_inside(self))
        return next((space for space in spaces if space.quantities), StateSpace())

    @property
    def parameter_units(self) -> dict[str, str]:
        """The units of learned parameters by name, for example "kg m²"; by default taken from the fields inside."""
        inside = (part.parameter_units for part in _fields_inside(self))
        return {name: unit for units in inside for name, unit in units.items()}


class HoldState(AbstractVectorField):
    """A baseline with ẋ = 0: the state does not change."""

    accepts_batch: ClassVar[bool] = True

    def __call__(self, x: Float[Array, " d *b"], u: Float[Array, " m *b"]) -> Float[Array, " d *b"]:
        return jnp.zeros_like(x)


class AbstractEstimator(eqx.Module):
    """An estimator between sensors and controller that learns while the system runs."""

    @abstractmethod
    def begin(self, x: Float[Array, " d"]) -> Any:
        """Return the state of the estimator before the first sample x."""

    @abstractmethod
    def update(self, state: Any, x: Float[Array, " d"], u: Float[Array, " m"]) -> Any:
        """Return the state of the estimator after one period with mean input u and the sample x at its end.

        Args:
            state: as returned by `begin` and `update`.
        """

    @abstractmethod
    def model(self, state: Any) -> AbstractVectorField:
        """Return the prediction model for the controller.

        Args:
            state: as returned by `begin` and `update`.
        """

    def start(self, state: Any, x: Float[Array, " d"]) -> Float[Array, " d+h"]:
        """Return the model's state at the last sample x; by default x, for a model without hidden states.

        Args:
            state: as returned by `begin` and `update`.
        """
        return x

    def command(self, state: Any, x: Float[Array, " d"], u: Float[Array, " m"]) -> Float[Array, " m"]:
        """Return the input to command if the controller requests u in the state x; by default u.

        Args:
            state: as returned by `begin` and `update`.
        """
        return u

    def effective(self, state: Any, u: Float[Array, " m"]) -> Float[Array, " m"]:
        """Return the model input with the same effect as the system input u, the inverse of `command`; by default u.

        Args:
            state: as returned by `begin` and `update`.
        """
        return u


def parts_of(tree: Any) -> Iterator[Any]:
    """Iterate over the tree, and all modules, containers and leaves inside it."""
    yield tree
    for child in jax.tree.leaves(tree, is_leaf=lambda node: node is not tree):
        if child is not tree:
            yield from parts_of(child)


def _fields_inside(tree) -> list[AbstractVectorField]:
    def is_inside(node) -> bool:
        return node is not tree and isinstance(node, AbstractVectorField)

    return [node for node in jax.tree.leaves(tree, is_leaf=is_inside) if is_inside(node)]


def state_space(field: AbstractVectorField, d: int | None = None) -> StateSpace:
    """Return the state space of a field, or of the first field inside another callable, padded to d numbers."""
    own = as_field(field).state_space
    return own if d is None else own.padded(d)


class _Function(AbstractVectorField):
    """A function or another module as a field, with default methods."""

    function: Callable

    def __call__(self, x, u):
        return self.function(x, u)

    @property
    def features_first(self):
        return getattr(self.function, "accepts_batch", False)

    def update_running_stats(self, x, u):
        return batching.with_moved_stats(self.function, x, u)

    def fuse_for_inference(self):
        return self.function


def as_field(field: Callable) -> AbstractVectorField:
    """Return the field itself, or a function of x and u wrapped as a field."""
    return field if isinstance(field, AbstractVectorField) else _Function(field)


def jvp_columns(function, values: tuple, columns: tuple) -> tuple[Float[Array, " e"], Columns]:
    """Return `function(*values)` (e,), and its derivatives (e, c) along the columns of `columns`."""
    value, slope = jax.linearize(function, *values)
    return value, jax.vmap(slope, in_axes=-1, out_axes=-1)(*columns)


def trainable(field: Any) -> Any:
    """Return a tree with True at each leaf that the optimiser may change, for example for `equinox.partition`.

    Args:
        field: any field. Its floating-point arrays are learned unless they are inside `Frozen`.
    """

    def fixed(node) -> bool:
        return isinstance(node, RunningStats | AbstractInferenceOnly | Trajectories)

    return jax.tree.map(lambda node: not fixed(node) and eqx.is_inexact_array(node), field, is_leaf=fixed)


def ravel_learned(field: Any) -> tuple[Float[Array, " p"], Callable[[Float[Array, " p"]], Any]]:
    """Return the learned numbers of a field as a vector, in the order of its leaves, and a function back to a field."""
    learned, rest = eqx.partition(field, trainable(field))
    theta, unravel = ravel_pytree(learned)
    return theta, lambda theta: eqx.combine(unravel(theta), rest)


def in_double(field: Learned) -> Learned:
    """Convert the arrays of a field or model to double precision, if JAX has it enabled."""
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, float) if eqx.is_inexact_array(leaf) else leaf, field)
