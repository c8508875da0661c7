"""Loops over columns: the layout of their entries in arrays and tables, and statements that fill arrays."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from hybrid_jax.codegen.nodes import (
    Address,
    Assign,
    Element,
    Entry,
    Expression,
    Loop,
    Operation,
    Statement,
    Variable,
    nested,
)
from hybrid_jax.codegen.tables import Tables

LOOPED = 8  # so many entries are copied by a loop


def is_contiguous(entries: np.ndarray) -> bool:
    """Whether all entries are numbers or contiguous in one array."""
    if all(isinstance(one, float) for one in entries):
        return True
    places = _places(entries)
    return places is not None and bool((np.diff(places) == 1).all())


def address(tables: Tables, entries: np.ndarray, stride: int = 0) -> Address:
    """Return the start of contiguous entries; in a loop with counter i0, each step advances by `stride`."""
    first = entries[0]
    if isinstance(first, Entry):
        return Address(first.name, first.index or 0, (stride,))
    return Address(tables.table(entries.astype(float)), 0, (stride,))


def indexed(tables: Tables, entries: np.ndarray, shape: tuple[int, ...]) -> Expression | None:
    """Return the entry at indices i0, i1, … of an array of this shape, or None if its place is not linear in them."""
    first = entries[0]
    if all(one == first for one in entries):
        return first
    if all(isinstance(one, float) for one in entries):
        return _in_table(tables, entries.astype(float).reshape(shape))
    if (places := _places(entries)) is None:
        return None
    grid = places.reshape(shape)
    corner = int(grid.flat[0])
    steps = [int(grid.take(1, axis).flat[0]) - corner if size > 1 else 0 for axis, size in enumerate(shape)]
    if not (grid == corner + np.tensordot(steps, np.indices(shape), 1)).all():
        return None
    return Element(first.name, corner, tuple(steps))


def _in_table(tables: Tables, grid: np.ndarray) -> Element:
    """Store a constant in a table, with one entry along axes on which it does not depend."""
    kept = [bool((grid != grid.take([0], axis)).any()) for axis in range(grid.ndim)]
    core = grid[tuple(slice(None) if keep else slice(0, 1) for keep in kept)]
    strides = tuple(stride if keep else 0 for stride, keep in zip(_strides(core.shape), kept, strict=True))
    return Element(tables.table(core.ravel()), 0, strides)


def _strides(shape: Sequence[int]) -> tuple[int, ...]:
    return tuple(int(np.prod(shape[axis + 1 :])) for axis in range(len(shape)))


def _places(entries: np.ndarray) -> np.ndarray | None:
    """Return the indices of entries of one array."""
    first = entries[0]
    if not isinstance(first, Entry) or first.index is None:
        return None
    if any(not isinstance(one, Entry) or one.name != first.name for one in entries):
        return None
    return np.array([one.index for one in entries])


def mapping(out: str, value: Expression, shape: tuple[int, ...]) -> Statement:
    """Set each entry of an array of this shape to a value that depends on its indices."""
    return nested(shape, Assign(Element(out, 0, _strides(shape)), value))


def folding(out: str, name: str, operand: Expression, shape: tuple[int, int]) -> Statement:
    """Reduce the entries of each row by a binary operation."""
    first = replace(operand, steps=operand.steps[:1]) if isinstance(operand, Element) else operand
    total = Entry("s")
    inner = Loop(1, shape[1], (Assign(total, Operation(name, (total, operand))),), start=1)
    return Loop(0, shape[0], (Variable("s", first, constant=False), inner, Assign(Element(out, 0, (1,)), total)))


def stores(out: str, entries: np.ndarray, begin: int = 0) -> tuple[Statement, ...]:
    """Write entries into an array from `begin` on, with loops for equal numbers and runs of another array."""
    statements, i = [], 0
    while i < len(entries):
        first, (run, step) = entries[i], _run(entries[i:])
        if run >= LOOPED:
            in_array = isinstance(first, Entry) and first.index is not None
            source = Element(first.name, first.index or 0, (step,)) if in_array else first
            statements.append(Loop(0, run, (Assign(Element(out, begin + i, (1,)), source),)))
        else:
            run = 1
            statements.append(Assign(Entry(out, begin + i), first))
        i += run
    return tuple(statements)


def _run(entries: np.ndarray) -> tuple[int, int]:
    """Return the length and stride of the leading run in one array, or of equal numbers."""
    first, step = entries[0], 0
    if (places := _places(entries[:2])) is not None and len(places) > 1:
        step = int(places[1] - places[0])
    for count, one in enumerate(entries):
        expected = replace(first, index=first.index + step * count) if step else first
        if one != expected:
            return count, step
    return len(entries), step
