"""Fields made of fields: physics plus a residual, the mean of models, a view of the state, a frozen field."""

from collections.abc import Iterable
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hybrid_jax.dynamics.base import AbstractVectorField, as_field, jvp_columns, ravel_learned
from hybrid_jax.dynamics.batching import AbstractInferenceOnly, batch_norms, moments_of


class Hybrid(AbstractVectorField):
    """ẋ = f_p(x, u; θ_p) + f_d(x, u; θ_d): physics plus what physics leaves out (paper, Eq. 4).

    Attributes:
        physics: f_p.
        residual: f_d, a network or any other field; physics maps what it returns, see `apply_residual`.
    """

    physics: AbstractVectorField
    residual: AbstractVectorField

    @property
    def _parts(self) -> tuple[AbstractVectorField, AbstractVectorField]:
        return as_field(self.physics), as_field(self.residual)

    def __call__(self, x: Float[Array, " d"], u: Float[Array, " m"]) -> Float[Array, " d"]:
        slope, added = self.physics(x, u), self._parts[0].apply_residual(x, self.residual(x, u))
        if jnp.shape(added) != jnp.shape(slope):
            raise ValueError(f"the residual must return {jnp.shape(slope)}, as physics does, got {jnp.shape(added)}")
        return slope + added

    def train_batch(self, x, u):
        physics, residual = self._parts
        return physics.train_batch(x, u) + physics.apply_residual(x, residual.train_batch(x, u))

    def infer_batch(self, x, u):
        physics, residual = self._parts
        return physics.infer_batch(x, u) + physics.apply_residual(x, residual.infer_batch(x, u))

    def update_running_stats(self, x, u):
        return Hybrid(*(part.update_running_stats(x, u) for part in self._parts))

    def apply_residual(self, x, residual):
        return self._parts[0].apply_residual(x, residual)

    def linearize(self, x, u, dx, du):
        physics, d_physics = self._parts[0].linearize(x, u, dx, du)
        values, columns = zip((x, dx), self._parts[1].linearize(x, u, dx, du), strict=True)
        added, d_added = jvp_columns(self.apply_residual, values, columns)
        return physics + added, d_physics + d_added

    def parameter_columns(self, x, u):
        value, columns = self.residual(x, u), self._parts[1].parameter_columns(x, u)
        moved = jvp_columns(lambda value: self.apply_residual(x, value), (value,), (columns,))[1]
        theta, at = ravel_learned(self.physics)
        mapped = jax.jacfwd(lambda theta: as_field(at(theta)).apply_residual(x, value))(theta)
        return jnp.concatenate([self._parts[0].parameter_columns(x, u) + mapped, moved], axis=1)

    @property
    def features_first(self):
        return any(part.features_first for part in self._parts)

    def fuse_for_inference(self):
        return Hybrid(*(part.fuse_for_inference() for part in self._parts))


class Blend(AbstractVectorField):
    """ẋ = the mean of several fields, such as models between which the data cannot decide.

    Attributes:
        fields: one or more, of the same state and input.
    """

    fields: tuple[AbstractVectorField, ...]

    def __call__(self, x: Float[Array, " d"], u: Float[Array, " m"]) -> Float[Array, " d"]:
        return self._mean(field(x, u) for field in self.fields)

    def train_batch(self, x, u):
        return self._mean(as_field(field).train_batch(x, u) for field in self.fields)

    def infer_batch(self, x, u):
        return self._mean(as_field(field).infer_batch(x, u) for field in self.fields)

    def update_running_stats(self, x, u):
        return Blend(tuple(as_field(field).update_running_stats(x, u) for field in self.fields))

    def apply_residual(self, x, residual):
        return self._mean(as_field(field).apply_residual(x, residual) for field in self.fields)

    def linearize(self, x, u, dx, du):
        values, columns = zip(*(as_field(field).linearize(x, u, dx, du) for field in self.fields), strict=True)
        return self._mean(values), self._mean(columns)

    @property
    def features_first(self):
        return any(as_field(field).features_first for field in self.fields)

    def fuse_for_inference(self):
        return Blend(tuple(as_field(field).fuse_for_inference() for field in self.fields))

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
        return self.write(x, as_field(self.field).train_batch(self.read(x), u))

    def infer_batch(self, x, u):
        return self.write(x, as_field(self.field).infer_batch(self.read(x), u))

    def update_running_stats(self, x, u):
        return eqx.tree_at(
            lambda wrapper: wrapper.field, self, as_field(self.field).update_running_stats(self.read(x), u)
        )

    def apply_residual(self, x, residual):
        return as_field(self.field).apply_residual(x, residual)

    def linearize(self, x, u, dx, du):
        features, d_features = jvp_columns(self.read, (x,), (dx,))
        inside, d_inside = as_field(self.field).linearize(features, u, d_features, du)
        return jvp_columns(self.write, (x, inside), (dx, d_inside))

    def fuse_for_inference(self):
        return eqx.tree_at(lambda wrapper: wrapper.field, self, as_field(self.field).fuse_for_inference())


class Frozen(AbstractWrapper, AbstractInferenceOnly):
    """A field in inference mode that training does not change: neither parameters nor running statistics move."""

    @property
    def features_first(self):
        return as_field(self.field).features_first

    def train_batch(self, x, u):
        return as_field(self.field).infer_batch(x, u)

    def update_running_stats(self, x, u):
        return self


def unfreeze(field: AbstractVectorField) -> AbstractVectorField:
    """The field without its `Frozen` wrappers.

    Args:
        field: any field; parts of it may be frozen, or all.
    """

    def frozen(node) -> bool:
        return isinstance(node, Frozen)

    return jax.tree.map(lambda node: unfreeze(node.field) if frozen(node) else node, field, is_leaf=frozen)


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
