"""The numbers of states and inputs of a field."""

from collections.abc import Iterator
from typing import Any

import equinox as eqx
import jax

from hybrid_jax import checks
from hybrid_jax.state import INPUT_SIZE, STATE_SIZE
from hybrid_jax.vehicle import Vehicle


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
