"""Differentiate the residuals of a hybrid in many directions by one product with the network's Jacobian."""

from dataclasses import replace
from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp

from hybrid_jax.dynamics.base import AbstractVectorField, as_field
from hybrid_jax.dynamics.composition import AbstractWrapper, Hybrid
from hybrid_jax.dynamics.disturbance import physics_of

Field = TypeVar("Field", bound=AbstractVectorField)


class ByProduct(AbstractWrapper):
    """A field that JAX differentiates by `linearize`."""

    def __call__(self, x, u):
        return _evaluate(self.field, x, u)


@eqx.filter_custom_jvp
def _evaluate(field, x, u):
    return field(x, u)


@_evaluate.def_jvp
def _evaluate_jvp(primals, tangents):
    (field, x, u), (moved, dx, du) = primals, tangents
    if jax.tree.leaves(moved):  # the weights move as well
        return eqx.filter_jvp(lambda field, x, u: field(x, u), primals, tangents)
    dx, du = (jnp.zeros_like(at) if d is None else d for at, d in ((x, dx), (u, du)))
    value, columns = as_field(field).linearize(x, u, dx[:, None], du[:, None])
    return value, columns[:, 0]


def fixed_residual(field: Field) -> Field:
    """Return the field with `ByProduct` around its residuals, for derivatives by θ_p or by the state."""
    if not isinstance(field, Hybrid) or physics_of(field) is field:
        return field
    fused = as_field(field.residual).fuse_for_inference()
    return replace(field, physics=fixed_residual(field.physics), residual=ByProduct(fused))
