"""Vector fields ẋ = f(x, u). Physics, a network, their sum and a user's own module are all vector fields.

A field maps one state x (d,) and one input u (m,) to ẋ (d,). Any function or Equinox module of this signature will do.
The functions below evaluate it on a batch, features first: x (d, b), u (m, b). They call the method of the same name
of an `AbstractVectorField`, whose defaults serve code for one sample; a subclass overrides what it can do faster.
"""

from abc import abstractmethod
from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import Any, ClassVar, Self

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from hybrid_jax.dynamics.batching import (
    AbstractInferenceOnly,
    Batch,
    RunningStats,
    batch_norms,
    moments_of,
    over_samples,
    training_mode,
    with_moved_stats,
)
from hybrid_jax.state_space import StateSpace
from hybrid_jax.trajectories import Trajectories, check

Columns = Float[Array, "d c"]  # derivatives of d numbers in c directions


class AbstractVectorField(eqx.Module):
    """ẋ = f(x, u). Every inexact array inside is learned (see `trainable`).

    Attributes:
        accepts_batch: whether `__call__` also accepts x (d, b) and u (m, b), for instance since it reads x[0], x[1], …
    """

    accepts_batch: ClassVar[bool] = False

    @abstractmethod
    def __call__(self, x: Float[Array, " d"], u: Float[Array, " m"]) -> Float[Array, " d"]:
        """ẋ of one sample, in inference mode."""

    def train_batch(self, x: Batch, u: Float[Array, "m b"]) -> Batch:
        """See the function `train_batch`, as for the methods that follow."""
        direct = features_first(self) and not batch_norms(self)
        return self(x, u) if direct else over_samples(training_mode(self))(x, u)

    def infer_batch(self, x: Batch, u: Float[Array, "m b"]) -> Batch:
        """ẋ of many samples in inference mode, a column for each."""
        return self(x, u) if features_first(self) else over_samples(self)(x, u)

    def update_running_stats(self, x: Batch, u: Float[Array, "m b"]) -> Self:
        """The field after one training batch: running statistics move, learned parameters do not."""
        return with_moved_stats(self, x, u)

    def apply_residual(self, x: Float[Array, " d *b"], residual: Float[Array, " d *b"]) -> Float[Array, " d *b"]:
        """What a residual adds to ẋ of this physics.

        Args:
            residual: what a network returned, in units of ẋ (d,).
        """
        return residual

    def linearize(self, x: Float[Array, " d"], u: Float[Array, " m"], dx: Columns, du: Columns):
        """ẋ of one sample in inference mode, and its derivative (d, c) along c directions.

        Args:
            dx: directions of the state, in columns (d, c).
            du: directions of the input, in columns (m, c).
        """
        return jvp_columns(self, (x, u), (dx, du))

    def parameter_columns(self, x: Float[Array, " d"], u: Float[Array, " m"]) -> Columns:
        """The derivative of ẋ of one sample along each of p learned numbers (d, p)."""
        theta, at = ravel_learned(self)
        return jax.jacfwd(lambda theta: at(theta)(x, u))(theta)

    def fuse_for_inference(self) -> "AbstractVectorField":
        """The same map in inference mode, in a layout that is faster for few samples at a time."""
        return self

    @property
    def state_space(self) -> StateSpace:
        """What its state is: by default what the first field inside it says that knows, else nothing."""
        return _space_inside(self)

    @property
    def parameter_units(self) -> dict[str, str]:
        """Units such as "kg m²" of its learned parameters, by name; by default those of the fields inside it."""
        inside = (part.parameter_units for part in _fields_inside(self))
        return {name: unit for units in inside for name, unit in units.items()}


def _fields_inside(tree) -> list[AbstractVectorField]:
    """The outermost fields in a tree, which is none of them."""

    def is_inside(node) -> bool:
        return node is not tree and isinstance(node, AbstractVectorField)

    return [node for node in jax.tree.leaves(tree, is_leaf=is_inside) if is_inside(node)]


def _space_inside(tree) -> StateSpace:
    spaces = (part.state_space for part in _fields_inside(tree))
    return next((space for space in spaces if space.quantities), StateSpace())


def state_space(field: AbstractVectorField, d: int | None = None) -> StateSpace:
    """What a state is to a field, or to what is no `AbstractVectorField` but has one inside.

    Args:
        field: any field.
        d: how many numbers a state has: those of which the field says nothing are quantities of their own.
    """
    own = field.state_space if isinstance(field, AbstractVectorField) else _space_inside(field)
    return own if d is None else own.padded(d)


def check_windows(field: AbstractVectorField, windows: Trajectories, name: str = "windows") -> Trajectories:
    """The windows, where need be with other numbers for the same states, so that none jumps.

    An angle that is given within a turn, or the sign of a quaternion, may jump where the state does not. Traced windows
    are returned as they are.

    Args:
        field: it says what a state is.
        windows: of any system.
        name: what messages call them.

    Raises:
        ValueError: malformed windows, or states that are none to the field.
    """
    check(windows, name)
    space = state_space(field, windows.x0.shape[-1])
    for part, states in (("x0", windows.x0), ("x", windows.x)):
        space.check(f"{name}: {part}", states)
    return continuous(field, windows)


def continuous(field: AbstractVectorField, windows: Trajectories) -> Trajectories:
    """As `check_windows`, of windows that were checked."""
    x = state_space(field, windows.x0.shape[-1]).continuous(windows.x0, windows.x)
    return windows if x is windows.x else replace(windows, x=x)


def _methods_of(field) -> type[AbstractVectorField]:
    """The class whose methods evaluate a field: the defaults for what is no `AbstractVectorField`."""
    return type(field) if isinstance(field, AbstractVectorField) else AbstractVectorField


def train_batch(field: AbstractVectorField, x: Batch, u: Float[Array, "m b"]) -> Batch:
    """ẋ on a minibatch in training mode: batch normalisation uses the moments of this minibatch."""
    return _methods_of(field).train_batch(field, x, u)


def infer_batch(field: AbstractVectorField, x: Batch, u: Float[Array, "m b"]) -> Batch:
    """ẋ of many samples in inference mode."""
    return _methods_of(field).infer_batch(field, x, u)


def update_running_stats(field: AbstractVectorField, x: Batch, u: Float[Array, "m b"]) -> AbstractVectorField:
    """The field after one training batch: running statistics move, learned parameters do not."""
    return _methods_of(field).update_running_stats(field, x, u)


def apply_residual(
    field: AbstractVectorField, x: Float[Array, " d *b"], residual: Float[Array, " d *b"]
) -> Float[Array, " d *b"]:
    """Map a residual ẋ onto the state derivative of this physics: identity, unless its state shows forces elsewhere."""
    return _methods_of(field).apply_residual(field, x, residual)


def linearize(
    field: AbstractVectorField, x: Float[Array, " d"], u: Float[Array, " m"], dx: Columns, du: Columns
) -> tuple[Float[Array, " d"], Columns]:
    """ẋ of one sample in inference mode, and its derivative along each pair of columns of dx (d, c) and du (m, c)."""
    return _methods_of(field).linearize(field, x, u, dx, du)


def parameter_columns(field: AbstractVectorField, x: Float[Array, " d"], u: Float[Array, " m"]) -> Columns:
    """The derivative of ẋ of one sample along each learned number (d, p), in the order of the leaves of the field."""
    return _methods_of(field).parameter_columns(field, x, u)


def fuse_for_inference(field: AbstractVectorField) -> AbstractVectorField:
    """The same map in inference mode, in a layout that is faster for few samples at a time. Identity by default."""
    return _methods_of(field).fuse_for_inference(field)


def jvp_columns(function, values: tuple, columns: tuple) -> tuple[Float[Array, " e"], Columns]:
    """`function(*values)` and its derivatives along the columns of `columns`: shapes (e,) and (e, c)."""
    value, slope = jax.linearize(function, *values)
    return value, jax.vmap(slope, in_axes=-1, out_axes=-1)(*columns)


class Hybrid(AbstractVectorField):
    """ẋ = f_p(x, u; θ_p) + f_d(x, u; θ_d): physics plus what physics leaves out (paper, Eq. 4).

    Attributes:
        physics: f_p.
        residual: f_d, a network or any other field; physics maps what it returns, see `apply_residual`.
    """

    physics: AbstractVectorField
    residual: AbstractVectorField

    def __call__(self, x: Float[Array, " d"], u: Float[Array, " m"]) -> Float[Array, " d"]:
        slope, added = self.physics(x, u), apply_residual(self.physics, x, self.residual(x, u))
        if jnp.shape(added) != jnp.shape(slope):
            raise ValueError(f"the residual must return {jnp.shape(slope)}, as physics does, got {jnp.shape(added)}")
        return slope + added

    def train_batch(self, x, u):
        return train_batch(self.physics, x, u) + apply_residual(self.physics, x, train_batch(self.residual, x, u))

    def infer_batch(self, x, u):
        return infer_batch(self.physics, x, u) + apply_residual(self.physics, x, infer_batch(self.residual, x, u))

    def update_running_stats(self, x, u):
        return Hybrid(update_running_stats(self.physics, x, u), update_running_stats(self.residual, x, u))

    def apply_residual(self, x, residual):
        return apply_residual(self.physics, x, residual)

    def linearize(self, x, u, dx, du):
        physics, d_physics = linearize(self.physics, x, u, dx, du)
        values, columns = zip((x, dx), linearize(self.residual, x, u, dx, du), strict=True)
        added, d_added = jvp_columns(self.apply_residual, values, columns)
        return physics + added, d_physics + d_added

    def parameter_columns(self, x, u):
        value, columns = self.residual(x, u), parameter_columns(self.residual, x, u)
        moved = jvp_columns(lambda value: self.apply_residual(x, value), (value,), (columns,))[1]
        theta, at = ravel_learned(self.physics)
        mapped = jax.jacfwd(lambda theta: apply_residual(at(theta), x, value))(theta)
        return jnp.concatenate([parameter_columns(self.physics, x, u) + mapped, moved], axis=1)

    def fuse_for_inference(self):
        return Hybrid(fuse_for_inference(self.physics), fuse_for_inference(self.residual))


class Blend(AbstractVectorField):
    """ẋ = the mean of several fields, such as models between which the data cannot decide.

    Attributes:
        fields: one or more, of the same state and input.
    """

    fields: tuple[AbstractVectorField, ...]

    def __call__(self, x: Float[Array, " d"], u: Float[Array, " m"]) -> Float[Array, " d"]:
        return self._mean(field(x, u) for field in self.fields)

    def train_batch(self, x, u):
        return self._mean(train_batch(field, x, u) for field in self.fields)

    def infer_batch(self, x, u):
        return self._mean(infer_batch(field, x, u) for field in self.fields)

    def update_running_stats(self, x, u):
        return Blend(tuple(update_running_stats(field, x, u) for field in self.fields))

    def apply_residual(self, x, residual):
        return self._mean(apply_residual(field, x, residual) for field in self.fields)

    def linearize(self, x, u, dx, du):
        values, columns = zip(*(linearize(field, x, u, dx, du) for field in self.fields), strict=True)
        return self._mean(values), self._mean(columns)

    def fuse_for_inference(self):
        return Blend(tuple(fuse_for_inference(field) for field in self.fields))

    def _mean(self, parts: Iterable[Array]) -> Array:
        first, *others = parts
        return sum(others, start=first) / len(self.fields)


class AbstractWrapper(AbstractVectorField):
    """ẋ = write(x, f(read(x), u)) for the field f inside.

    Attributes:
        field: the field inside.
    """

    accepts_batch: ClassVar[bool] = True

    field: AbstractVectorField

    def read(self, x: Float[Array, " d *b"]) -> Float[Array, " n *b"]:
        """The features of the state that the field inside reads; by default all."""
        return x

    def write(self, x: Float[Array, " d *b"], inside: Float[Array, " n *b"]) -> Float[Array, " d *b"]:
        """ẋ from what the field inside returned; by default the same.

        Args:
            inside: what the field inside returned (n).
        """
        return inside

    def __call__(self, x: Float[Array, " d"], u: Float[Array, " m"]) -> Float[Array, " d"]:
        return self.write(x, self.field(self.read(x), u))

    def train_batch(self, x, u):
        return self.write(x, train_batch(self.field, self.read(x), u))

    def infer_batch(self, x, u):
        return self.write(x, infer_batch(self.field, self.read(x), u))

    def update_running_stats(self, x, u):
        return eqx.tree_at(lambda wrapper: wrapper.field, self, update_running_stats(self.field, self.read(x), u))

    def apply_residual(self, x, residual):
        return apply_residual(self.field, x, residual)

    def linearize(self, x, u, dx, du):
        features, d_features = jvp_columns(self.read, (x,), (dx,))
        inside, d_inside = linearize(self.field, features, u, d_features, du)
        return jvp_columns(self.write, (x, inside), (dx, d_inside))

    def fuse_for_inference(self):
        return eqx.tree_at(lambda wrapper: wrapper.field, self, fuse_for_inference(self.field))


class Frozen(AbstractWrapper, AbstractInferenceOnly):
    """A field in inference mode that training does not change: neither parameters nor running statistics move."""

    def train_batch(self, x, u):
        return infer_batch(self.field, x, u)

    def update_running_stats(self, x, u):
        return self


def features_first(field: AbstractVectorField) -> bool:
    """Whether some part of a sum has a batched form, so that the batch is best kept on the last axis."""
    if isinstance(field, Hybrid):
        return features_first(field.physics) or features_first(field.residual)
    if isinstance(field, Blend):
        return any(map(features_first, field.fields))
    return features_first(field.field) if isinstance(field, Frozen) else getattr(field, "accepts_batch", False)


def unfreeze(field: AbstractVectorField) -> AbstractVectorField:
    """The field without its `Frozen` wrappers.

    Args:
        field: any field; parts of it may be frozen, or all.
    """

    def frozen(node) -> bool:
        return isinstance(node, Frozen)

    return jax.tree.map(lambda node: unfreeze(node.field) if frozen(node) else node, field, is_leaf=frozen)


def trainable(field: Any) -> Any:
    """A tree with True at each leaf that the optimiser may move, for `equinox.partition`.

    Args:
        field: the field that the tree is like; its arrays of floating-point numbers are learned, unless frozen.
    """

    def fixed(node) -> bool:
        return isinstance(node, RunningStats | Frozen)

    return jax.tree.map(lambda node: not fixed(node) and eqx.is_inexact_array(node), field, is_leaf=fixed)


def ravel_learned(field: Any) -> tuple[Float[Array, " p"], Callable[[Float[Array, " p"]], Any]]:
    """The learned numbers of a field as a vector, in the order of its leaves, and the field as a function of them."""
    learned, rest = eqx.partition(field, trainable(field))
    theta, unravel = ravel_pytree(learned)
    return theta, lambda theta: eqx.combine(unravel(theta), rest)


def check_batch_norm(
    field: AbstractVectorField, x: Float[Array | np.ndarray, "d b"], u: Float[Array | np.ndarray, "m b"]
) -> None:
    """Refuse a field whose batch normalisation would be trained, but whose running statistics could not be.

    Raises:
        ValueError: at any x and u it does not evaluate a `BatchNorm` that it holds, or hides it from differentiation.
    """
    if _is_wrapped(field) and not all(all(count.tolist()) for count, *_ in moments_of(field, x, u)):
        raise ValueError(
            f"field: {type(field).__name__} holds a BatchNorm whose minibatch statistics cannot be recorded, as under "
            "stop_gradient or jax.grad; use norm='layer' or 'none', or wrap it in Frozen"
        )


def _is_wrapped(field) -> bool:
    """Whether a module of which the library knows nothing stands around a batch normalisation."""
    if getattr(type(field), "update_running_stats", None) in (None, AbstractVectorField.update_running_stats):
        return bool(batch_norms(field))
    return any(_is_wrapped(part) for part in vars(field).values() if isinstance(part, AbstractVectorField))
