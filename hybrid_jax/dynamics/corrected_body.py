"""A rigid body with what its own parameters cannot express: rotors that lost thrust, and air drag."""

from operator import mul

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hybrid_jax import rotation
from hybrid_jax.dynamics.base import AbstractVectorField, apply_residual
from hybrid_jax.dynamics.disturbance import (
    ConstantDisturbance,
    disturbance_of,
    physics_of,
    with_physics,
    without_disturbance,
)
from hybrid_jax.dynamics.rigid_body import AbstractRigidBody
from hybrid_jax.state import QUATERNION, STATE_SIZE, VELOCITY


class CorrectedBody(AbstractRigidBody):
    """ẋ = f(x, √e ∘ u) − R diag(c) Rᵀ v in the velocity: a rigid body f whose rotors and air resistance have changed.

    A rotor of efficiency e gives e times the thrust and the reaction torque of a sound one at the same speed.
    """

    body: AbstractRigidBody
    log_efficiency: Float[Array, " m"]  # log e of each rotor
    drag: Float[Array, "3"]  # c [1/s], in the body frame, beside any that the body has

    @property
    def vehicle(self):
        return self.body.vehicle  # pyright: ignore[reportAttributeAccessIssue]

    def theta(self) -> dict[str, Array]:
        return self.body.theta() | {"efficiency": jnp.exp(self.log_efficiency), "added_drag": self.drag}

    def __call__(self, x: Float[Array, " 13"], u: Float[Array, " m"]) -> Float[Array, " 13"]:
        rows, velocity = rotation.matrix(x[QUATERNION]), x[VELOCITY]
        columns = zip(*rows, strict=True)
        in_body = [c * sum(map(mul, column, velocity)) for c, column in zip(self.drag, columns, strict=True)]
        slowed = jnp.stack([sum(map(mul, row, in_body)) for row in rows])
        return self.body(x, jnp.exp(self.log_efficiency / 2) * u).at[VELOCITY].add(-slowed)

    def apply_residual(self, x, residual):
        return apply_residual(self.body, x, residual)


CorrectedBody.accepts_batch = False


def corrected(field: AbstractVectorField, rotors: int) -> AbstractVectorField:
    """The field with its rigid body as a `CorrectedBody` that changes nothing yet; itself if it has none."""
    physics = physics_of(field)
    found = [part for part in jax.tree.leaves(physics, is_leaf=_is_body) if _is_body(part)]
    if not found or isinstance(found[0], CorrectedBody):
        return field
    dtype = jnp.result_type(*jax.tree.leaves(eqx.filter(found[0], eqx.is_inexact_array)))
    body = CorrectedBody(found[0], jnp.zeros(rotors, dtype), jnp.zeros(3, dtype))
    return with_physics(field, jax.tree.map(lambda node: body if _is_body(node) else node, physics, is_leaf=_is_body))


def simplified(field: AbstractVectorField) -> AbstractVectorField:
    """The field without corrections and disturbances that are zero; outside of compiled code."""

    def plain(node):
        if not isinstance(node, CorrectedBody):
            return node
        changed = any(np.asarray(part).any() for part in (node.log_efficiency, node.drag))
        return node if changed else node.body

    field = jax.tree.map(plain, field, is_leaf=_is_body)
    found = disturbance_of(field)
    if found is None or np.asarray(found.value).all():
        return field
    size = np.shape(found.value)[0]
    kept = np.flatnonzero(found.value)
    if not len(kept):
        return without_disturbance(field)
    indices = found.indices or tuple(range(STATE_SIZE - size, STATE_SIZE))
    return eqx.tree_at(disturbance_of, field, ConstantDisturbance(found.value[kept], tuple(indices[i] for i in kept)))


def _is_body(node) -> bool:
    return isinstance(node, AbstractRigidBody)
