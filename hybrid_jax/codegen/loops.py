"""Loops over entries of arrays and tables, and statements that fill arrays."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from hybrid_jax.codegen.nodes import Address, Assign, Entry, Expression, Function, Loop, Operation, Statement, nested

LOOPED = 8  # entries from which on a loop copies them


@dataclass
class Tables:
    """The functions of a file, and its tables of numbers in double or single precision, by name."""

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


def address(tables: Tables, array: np.ndarray) -> Address | None:
    """Return the address of entries if they are contiguous in an array, or numbers, which become a table."""
    if _are_numbers(array):
        return Address(tables.table(array.ravel()))
    places = _places(array)
    contiguous = places is not None and (np.diff(places.ravel()) == 1).all()
    return Address(array.flat[0].name, array.flat[0].index) if contiguous else None


def indexed(tables: Tables, array: np.ndarray) -> Expression | None:
    """Return the entry at indices i0, i1, … as an expression, or None if its place is not linear in them."""
    first = array.flat[0]
    if all(one == first for one in array.flat):
        return first
    if _are_numbers(array):  # a table, with one entry along axes on which it does not depend
        kept = [bool((array != array.take([0], axis)).any()) for axis in range(array.ndim)]
        core = array[tuple(slice(None) if keep else slice(0, 1) for keep in kept)]
        strides = np.array(_strides(core.shape)) * kept
        return Entry(tables.table(core.ravel()), 0, tuple(strides.tolist()))
    if (places := _places(array)) is None:
        return None
    corner = int(places.flat[0])
    steps = [int(places.take(1, axis).flat[0]) - corner if size > 1 else 0 for axis, size in enumerate(array.shape)]
    linear = (places == corner + np.tensordot(steps, np.indices(array.shape), 1)).all()
    return Entry(first.name, corner, tuple(steps)) if linear else None


def _strides(shape: Sequence[int]) -> tuple[int, ...]:
    return tuple(int(np.prod(shape[axis + 1 :])) for axis in range(len(shape)))


def _are_numbers(array: np.ndarray) -> bool:
    return all(isinstance(one, float | bool) for one in array.flat)


def _places(array: np.ndarray) -> np.ndarray | None:
    """Return the indices of entries of one array, or None for others."""
    first = array.flat[0]
    if any(not isinstance(one, Entry) or one.name != first.name or one.index is None for one in array.flat):
        return None
    return np.array([one.index for one in array.flat]).reshape(array.shape)


def mapping(out: str, value: Expression, shape: tuple[int, ...]) -> Statement:
    """Set each entry of an array of this shape to a value that depends on its indices."""
    return nested(shape, Assign(Entry(out, 0, _strides(shape)), value))


def folding(out: str, name: str, operand: Expression, shape: tuple[int, int]) -> Statement:
    """Reduce the entries of each row by a binary operation."""
    first = replace(operand, steps=operand.steps[:1]) if isinstance(operand, Entry) else operand
    total = Entry(out, 0, (1,))
    more = Loop("i1", shape[1], (Assign(total, Operation(name, (total, operand))),), start=1)
    return nested(shape[:1], Assign(total, first), more)


def stores(out: str, entries: np.ndarray, begin: int = 0) -> tuple[Statement, ...]:
    """Write entries into an array from `begin` on, with loops for equal numbers and runs of another array."""
    statements, i = list[Statement](), 0
    while i < len(entries):
        first, (run, step) = entries[i], _run(entries[i:])
        if run >= LOOPED:
            source = Entry(first.name, first.index, (step,)) if step else first
            statements.append(nested((run,), Assign(Entry(out, begin + i, (1,)), source)))
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
