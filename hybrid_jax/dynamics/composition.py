"""Fields made of fields: physics plus a residual, a view of the state, a frozen field."""

from abc import abstractmethod
from collections.abc import Iterable
from typing import Self

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hybrid_jax.dynamics.base import AbstractVectorField, as_field, jvp_columns, ravel_learned, state_space
from hybrid_jax.dynamics.batching import AbstractInferenceOnly, batch_norms, moments_of


class AbstractComposite(AbstractVectorField):
    """ẋ = write(x, f₁(read(x), u), f₂(read(x), u), …) for the fields inside."""

    @property
    @abstractmethod
    def inside(self) -> tuple[AbstractVectorField, ...]:
        """The fields inside, f₁, f₂, …"""

    def read(self, x: Float[Array, " d *b"]) -> Float[Array, " n *b"]:
        """Return the features of the state that the fields inside read; by default all."""
        return x

    @abstractmethod
    def write(self, x: Float[Array, " d *b"], *inside: Float[Array, " n *b"]) -> Float[Array, " d *b"]:
        """Return ẋ from the outputs of the fields inside.

        Args:
            inside: output of each field inside (n).
        """

    @property
    def _parts(self) -> list[AbstractVectorField]:
        return [as_field(field) for field in self.inside]

    def _moved(self, fields: Iterable[AbstractVectorField]) -> Self:
        return eqx.tree_at(lambda composite: composite.inside, self, tuple(fields))

    def __call__(self, x: Float[Array, " d"], u: Float[Array, " m"]) -> Float[Array, " d"]:
        seen = self.read(x)
        return self.write(x, *(field(seen, u) for field in self.inside))

    def train_batch(self, x, u):
        seen = self.read(x)
        return self.write(x, *(field.train_batch(seen, u) for field in self._parts))

    def infer_batch(self, x, u):
        seen = self.read(x)
        return self.write(x, *(field.infer_batch(seen, u) for field in self._parts))

    def update_running_stats(self, x, u):
        seen = self.read(x)
        return self._moved(field.update_running_stats(seen, u) for field in self._parts)

    def linearize(self, x, u, dx, du):
        seen, d_seen = jvp_columns(self.read, (x,), (dx,))
        values, columns = zip(*(field.linearize(seen, u, d_seen, du) for field in self._parts), strict=True)
        return jvp_columns(self.write, (x, *values), (dx, *columns))

    def fuse_for_inference(self):
        return self._moved(field.fuse_for_inference() for field in self._parts)

    @property
    def features_first(self):
        return any(field.features_first for field in self._parts)


class Hybrid(AbstractComposite):
    """A hybrid model ẋ = f_p(x, u; θ_p) + f_d(x, u; θ_d): physics plus a residual for what it lacks (paper, Eq. 4).

    Quaternions q and −q are the same attitude, so the residual always reads the one with w ≥ 0.

    Attributes:
        physics: f_p, any field.
        residual: f_d, a network or any other field. Physics may transform its output; see `apply_residual`.
    """

    physics: AbstractVectorField
    residual: AbstractVectorField

    @property
    def inside(self) -> tuple[AbstractVectorField, AbstractVectorField]:
        return self.physics, self.residual

    def read(self, x):
        return state_space(self.physics).canonical(x, x)

    def write(self, x, *inside):
        slope, added = inside[0], self.apply_residual(self.read(x), inside[1])
        if jnp.shape(added) != jnp.shape(slope):
            raise ValueError(f"the residual must return {jnp.shape(slope)}, as physics does, got {jnp.shape(added)}")
        return state_space(self.physics).canonical(x, slope + added)

    def apply_residual(self, x, residual):
        return as_field(self.physics).apply_residual(x, residual)

    def parameter_columns(self, x, u):
        (physics, residual), seen = self._parts, self.read(x)
        value, columns = residual(seen, u), residual.parameter_columns(seen, u)
        moved = jvp_columns(lambda value: self.apply_residual(seen, value), (value,), (columns,))[1]
        theta, at = ravel_learned(self.physics)
        mapped = jax.jacfwd(lambda theta: as_field(at(theta)).apply_residual(seen, value))(theta)
        columns = jnp.concatenate([physics.parameter_columns(seen, u) + mapped, moved], axis=1)
        return state_space(self.physics).canonical(x, columns)


class AbstractWrapper(AbstractComposite):
    """ẋ = write(x, f(read(x), u)) for one field f inside; `read` and `write` are the identity by default.

    Attributes:
        field: the field inside.
    """

    field: AbstractVectorField

    @property
    def inside(self) -> tuple[AbstractVectorField, ...]:
        return (self.field,)

    def write(self, x, inside):
        return inside

    def apply_residual(self, x, residual):
        return as_field(self.field).apply_residual(x, residual)


class Frozen(AbstractWrapper, AbstractInferenceOnly):
    """A field that does not change in training. It is in inference mode, and keeps its running statistics."""

    def train_batch(self, x, u):
        return self.infer_batch(x, u)

    def update_running_stats(self, x, u):
        return self


def unfreeze(field: AbstractVectorField) -> AbstractVectorField:
    """Return the field without its `Frozen` wrappers, for example to train it further.

    Args:
        field: any field that is frozen, or has parts that are.
    """

    def frozen(node) -> bool:
        return isinstance(node, Frozen)

    return jax.tree.map(lambda node: unfreeze(node.field) if frozen(node) else node, field, is_leaf=frozen)


def check_batch_norm(
    field: AbstractVectorField, x: Float[Array | np.ndarray, "d b"], u: Float[Array | np.ndarray, "m b"]
) -> None:
    """Raise ValueError for a BatchNorm that is not evaluated at x and u, or cannot be differentiated."""
    if _is_wrapped(field) and not all(all(count.tolist()) for count, *_ in moments_of(field, x, u)):
        raise ValueError(
            f"field: {type(field).__name__} contains a BatchNorm whose minibatch statistics cannot be recorded, "
            "e.g. in stop_gradient or jax.grad; use norm='layer' or 'none', or wrap it in Frozen"
        )


def _is_wrapped(field) -> bool:
    """Whether a module of unknown class contains a batch normalisation."""
    if getattr(type(field), "update_running_stats", None) in (None, AbstractVectorField.update_running_stats):
        return bool(batch_norms(field))
    return any(_is_wrapped(part) for part in vars(field).values() if isinstance(part, AbstractVectorField))
