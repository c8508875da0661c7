"""A constant disturbance of the state derivative, for example steady wind, an off-centre load or a biased actuator."""

from collections.abc import Sequence
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hybrid_jax import checks
from hybrid_jax.dynamics.base import AbstractVectorField, state_space
from hybrid_jax.dynamics.composition import Hybrid


class ConstantDisturbance(AbstractVectorField):
    """A constant ẋ = d: the value at the disturbed states and zero at the others, for all x and u.

    Attributes:
        value: d (k), one number for each disturbed state in its unit per second; instead, a scalar acts on every state.
        indices: the disturbed states; by default the last k.
        points: number of consecutive states that share each number, for a grid.
    """

    accepts_batch: ClassVar[bool] = True

    value: Float[Array, "*k"]
    indices: tuple[int, ...] | None = eqx.field(static=True, default=None)
    points: int = eqx.field(static=True, default=1)

    def __check_init__(self):
        if self.indices is not None and jnp.shape(self.value)[-1:] != (len(self.indices),):
            raise ValueError(f"indices must match a value of shape {jnp.shape(self.value)}, got {self.indices}")

    def __call__(self, x: Float[Array, " d *b"], u: Float[Array, " m *b"]) -> Float[Array, " d *b"]:
        return jnp.broadcast_to(self.vector(len(x)).reshape(-1, *(1,) * (x.ndim - 1)), x.shape)

    def vector(self, d: int) -> Float[Array, " d"]:
        """Return ẋ (d,), which is the same for all x and u; ValueError if an index is out of range.

        Args:
            d: size of the state.
        """
        if self.value.ndim == 0:
            return jnp.broadcast_to(self.value, (d,))
        if self.points > 1:
            return jnp.repeat(self.value, self.points)
        if self.indices is None:
            return jnp.concatenate([jnp.zeros(d - len(self.value), self.value.dtype), self.value])
        if not 0 <= min(self.indices) <= max(self.indices) < d:
            raise ValueError(f"indices must be between 0 and {d - 1}, got {self.indices}")
        entries, zero = dict(zip(self.indices, self.value, strict=True)), jnp.zeros((), self.value.dtype)
        return jnp.stack([entries.get(i, zero) for i in range(d)])


def with_disturbance(field: AbstractVectorField, indices: tuple[int, ...] | None = None) -> AbstractVectorField:
    """Return the field with a constant disturbance in its physics, which is zero unless the field already has one.

    Args:
        field: physics, or a hybrid.
        indices: the disturbed states; by default given by the state space of the physics, for example v̇ and ω̇ of a
            rigid body, or each component of physics on a `Grid` (one number for all points). ValueError if the field
            already has a nonzero disturbance of other states.
    """
    if (known := disturbance_of(field)) is not None:
        if indices is None or indices == known.indices:
            return field
        if checks.is_traced(known.value) or jnp.any(known.value != 0):
            raise ValueError("indices: the field already has a disturbance of other states; see without_disturbance")
        field = without_disturbance(field)
    physics = physics_of(field)
    dtypes = (leaf.dtype for leaf in jax.tree.leaves(eqx.filter(physics, eqx.is_inexact_array)))
    space, shape, points = state_space(physics), (), 1
    if indices is not None:
        shape = (len(indices),)
    elif space.disturbed is not None:
        own = range(space.size)[space.disturbed]
        shape, indices = (len(own),), None if own.stop == space.size else tuple(own)
    elif (sizes := {one.size for one in space.quantities if one.uniform}) and len(sizes) == 1:
        shape, points = (len(space.quantities),), sizes.pop()
    zero = ConstantDisturbance(jnp.zeros(shape, jnp.result_type(*dtypes, jnp.float32)), indices, points)
    return with_physics(field, Hybrid(physics, zero))


def without_disturbance(field: AbstractVectorField) -> AbstractVectorField:
    physics = physics_of(field)
    return with_physics(field, physics.physics) if isinstance(physics, Hybrid) else field


def sized(field: AbstractVectorField, d: int) -> AbstractVectorField:
    """Replace a scalar disturbance of the field's physics by one number for each of d states."""
    found = disturbance_of(field)
    if found is None or found.value.ndim > 0:
        return field
    return eqx.tree_at(disturbance_of, field, ConstantDisturbance(found.vector(d)))


def physics_of(field: AbstractVectorField) -> AbstractVectorField:
    """Return the physics of a hybrid, with its constant disturbance if it has one; else the field itself."""
    while isinstance(field, Hybrid) and not isinstance(field.residual, ConstantDisturbance):
        field = field.physics
    return field


def with_physics(field: AbstractVectorField, physics: AbstractVectorField) -> AbstractVectorField:
    return eqx.tree_at(physics_of, field, physics)


def disturbance_of(field: AbstractVectorField) -> ConstantDisturbance | None:
    physics = physics_of(field)
    return physics.residual if isinstance(physics, Hybrid) else None  # pyright: ignore[reportReturnType]


def disturbance_units(field: AbstractVectorField) -> dict[str, str]:
    """Return name → unit (or "") of each number of the disturbance, for example disturbance[vx] or disturbance[0]."""
    if (found := disturbance_of(field)) is None:
        return {}
    space = state_space(field)
    if found.points > 1 or not space.size:
        return {f"disturbance[{i}]": "" for i in _indices(field, found)}
    units = (f"{unit}²" if unit.endswith("/s") else f"{unit}/s" if unit else "" for unit in space.units)
    named = dict(enumerate(zip(space.names, units, strict=True)))
    return {f"disturbance[{name}]": unit for name, unit in map(named.__getitem__, _indices(field, found))}


def _indices(field: AbstractVectorField, found: ConstantDisturbance) -> Sequence[int]:
    """Return the indices of the disturbed states; for a grid, of the disturbed components."""
    if found.indices is not None:
        return found.indices
    k = jnp.size(found.value)
    return range(k) if found.points > 1 else range(max(state_space(field).size, k))[-k:]


def without_zeros(field: AbstractVectorField) -> AbstractVectorField:
    """Return the field with its constant disturbance restricted to nonzero entries; outside of compiled code."""
    found = disturbance_of(field)
    if found is None or np.asarray(found.value).all():
        return field
    kept = np.flatnonzero(found.value)
    if not len(kept):
        return without_disturbance(field)
    if found.points > 1:
        return field
    indices = np.asarray(_indices(field, found))[kept].tolist()
    return eqx.tree_at(disturbance_of, field, ConstantDisturbance(found.value[kept], tuple(indices)))
