"""What is exported of a field: a function of x and u in one precision, and its sizes."""

from collections.abc import Iterator, Sequence
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from hybrid_jax import checks
from hybrid_jax.dynamics.base import AbstractVectorField, infer_batch
from hybrid_jax.integrate import Derivative, check_field, rk4_step
from hybrid_jax.state import INPUT_SIZE, STATE_SIZE
from hybrid_jax.vehicle import Vehicle


def program_of(
    field: AbstractVectorField, likes: Sequence[jax.ShapeDtypeStruct], dt: float | None, batched: bool = False
) -> Derivative:
    """ẋ = f(x, u), or the step of RK4 over dt [s], of a field with its numbers in the precision of `likes`.

    Args:
        likes: of one x and one u.
        batched: for a function of rows of them.

    Raises:
        ValueError: the field does not accept such x and u.
    """
    precision = likes[0].dtype
    field = jax.tree.map(lambda leaf: jnp.asarray(leaf, precision) if eqx.is_inexact_array(leaf) else leaf, field)
    check_field(field, *likes)
    derivative = _of_rows(field) if batched else field
    whole = derivative if dt is None else partial(rk4_step, derivative, dt=dt)
    return lambda x, u: whole(x, u)  # jax.jit needs a hashable function


def _of_rows(field: AbstractVectorField) -> Derivative:
    return lambda x, u: jnp.moveaxis(infer_batch(field, jnp.moveaxis(x, 0, -1), jnp.moveaxis(u, 0, -1)), -1, 0)


def sizes_of(field: Any, state_size: int | None, input_size: int | None) -> tuple[int, int]:
    """The sizes that are given, or else those that the field knows.

    A field knows them if it, or a field in it, has attributes `state_size` and `input_size`, or a `vehicle`.

    Raises:
        ValueError: a size that is not a count, or one that is neither given nor known.
    """
    known = next(filter(None, map(_own_sizes, _modules(field))), (None, None))
    sizes = state_size if state_size is not None else known[0], input_size if input_size is not None else known[1]
    for name, size in zip(("state_size", "input_size"), sizes, strict=True):
        if size is None:
            raise ValueError(f"{name} must be given: {type(field).__name__} does not know its size")
    checks.count("state_size", sizes[0])
    checks.count("input_size", sizes[1], least=0)
    return sizes  # pyright: ignore[reportReturnType]


def _own_sizes(module: eqx.Module) -> tuple[int, int] | None:
    if isinstance(getattr(module, "vehicle", None), Vehicle):
        return STATE_SIZE, INPUT_SIZE
    sizes = getattr(module, "state_size", None), getattr(module, "input_size", None)
    return None if None in sizes else sizes  # pyright: ignore[reportReturnType]


def _modules(tree: Any) -> Iterator[eqx.Module]:
    """All modules in a tree, the outermost first."""
    if isinstance(tree, eqx.Module):
        yield tree
    for child in jax.tree.leaves(tree, is_leaf=lambda node: node is not tree):
        if child is not tree:
            yield from _modules(child)
