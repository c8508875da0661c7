"""Loops over columns: the layout of their entries in arrays and tables, and statements that fill arrays."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from hybrid_jax.codegen.nodes import Address, Assign, Entry, Expression, Function, Loop, Operation, Statement, nested

LOOPED = 8  # so many entries are copied by a loop


@dataclass
class Tables:
    """Functions of a file, and its tables of numbers in double or single precision, by unused names."""

    double: bool
    functions: dict[str, Function] = field(default_factory=dict)
    numbers: dict[str, np.ndarray] = field(default_factory=dict)
    _known: dict[bytes, str] = field(default_factory=dict)  # bytes of the numbers → name
    _count: int = 0

    def name(self, letter: str) -> str:
        self._count += 1
        return f"{letter}{self._count}"

    def table(self, numbers: np.ndarray) -> str:
        """Add a table, or reuse an equal one, and return its name."""
        numbers = np.asarray(numbers, float if self.double else np.float32)
        name = self._known.setdefault(numbers.tobytes(), f"c{len(self._known)}")
        self.numbers[name] = numbers
        return name


def is_contiguous(entries: np.ndarray) -> bool:
    """Whether all entries are numbers or contiguous in one array."""
    if all(isinstance(one, float) for one in entries):
        return True
    places = _places(entries)
    return places is not None and bool((np.diff(places) == 1).all())


def address(tables: Tables, entries: np.ndarray) -> Address:
    """Return the start of contiguous entries."""
    first = entries[0]
    return (
        Address(first.name, first.index or 0, first.logical)
        if isinstance(first, Entry)
        else Address(tables.table(entries))
    )


def indexed(tables: Tables, entries: np.ndarray, shape: tuple[int, ...]) -> Expression | None:
    """Return the entry at indices i0, i1, … of an array of this shape, or None if its place is not linear in them."""
    first = entries[0]
    if all(one == first for one in entries):
        return first
    if all(isinstance(one, float) for one in entries):  # a table, with one entry along axes that do not matter
        grid = entries.astype(float).reshape(shape)
        kept = [bool((grid != grid.take([0], axis)).any()) for axis in range(grid.ndim)]
        core = grid[tuple(slice(None) if keep else slice(0, 1) for keep in kept)]
        strides = np.array(_strides(core.shape)) * kept
        return Entry(tables.table(core.ravel()), 0, steps=tuple(strides.tolist()))
    if (places := _places(entries)) is None:
        return None
    grid = places.reshape(shape)
    corner = int(grid.flat[0])
    steps = [int(grid.take(1, axis).flat[0]) - corner if size > 1 else 0 for axis, size in enumerate(shape)]
    linear = (grid == corner + np.tensordot(steps, np.indices(shape), 1)).all()
    return Entry(first.name, corner, steps=tuple(steps)) if linear else None


def _strides(shape: Sequence[int]) -> tuple[int, ...]:
    return tuple(int(np.prod(shape[axis + 1 :])) for axis in range(len(shape)))


def _places(entries: np.ndarray) -> np.ndarray | None:
    """Return the indices of entries of one array."""
    name = entries[0].name if isinstance(entries[0], Entry) else None
    if any(not isinstance(one, Entry) or one.name != name or one.index is None for one in entries):
        return None
    return np.array([one.index for one in entries])


def mapping(out: str, value: Expression, shape: tuple[int, ...]) -> Statement:
    """Set each entry of an array of this shape to a value that depends on its indices."""
    return nested(shape, Assign(Entry(out, 0, steps=_strides(shape)), value))


def folding(out: str, name: str, operand: Expression, shape: tuple[int, int]) -> Statement:
    """Reduce the entries of each row by a binary operation."""
    first = replace(operand, steps=operand.steps[:1]) if isinstance(operand, Entry) else operand
    total = Entry(out, 0, steps=(1,))
    more = Loop("i1", shape[1], (Assign(total, Operation(name, (total, operand))),), start=1)
    return nested(shape[:1], Assign(total, first), more)


def stores(out: str, entries: np.ndarray, begin: int = 0) -> tuple[Statement, ...]:
    """Write entries into an array from `begin` on, with loops for equal numbers and runs of another array."""
    statements, i = list[Statement](), 0
    while i < len(entries):
        first, (run, step) = entries[i], _run(entries[i:])
        if run >= LOOPED:
            source = Entry(first.name, first.index, steps=(step,)) if step else first
            statements.append(nested((run,), Assign(Entry(out, begin + i, steps=(1,)), source)))
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
        if one != (replace(first, index=first.index + step * count) if step else first):
            return count, step
    return len(entries), step
