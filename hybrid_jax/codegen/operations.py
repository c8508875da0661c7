"""Translate JAX programs into C99: a few entries as expressions, simplified at zeros and ones, many as loops.

A column is a NumPy array of objects: numbers (floats or bools), and `Entry` for computed values. Sparse Jacobians of
physics become straight-line code, and network layers become loops over tables and arrays.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from functools import reduce
from itertools import repeat
from typing import Any, ClassVar

import numpy as np

from hybrid_jax.codegen import loops
from hybrid_jax.codegen.loops import Tables
from hybrid_jax.codegen.nodes import (
    Address,
    Array,
    Call,
    Entry,
    Expression,
    Loop,
    Operation,
    Row,
    Statement,
    Step,
    Variable,
    arranged,
    names,
)
from hybrid_jax.codegen.printer import OPERATIONS
from hybrid_jax.codegen.translation import Entries, Translation, Value

EXPANDED = 24  # operations on at most so many entries are written out; more become a loop if they can
COPIED = 200  # and on at most so many if they cannot
PRODUCTS = 160  # multiplications of a matrix product that are written out

LOGICAL = ("lt", "le", "gt", "ge", "eq", "ne", "and", "or", "not")
IDENTITY = ("copy", "copy_p", "stop_gradient")
_NUMBERS: dict[str, Callable] = {
    "add": lambda a, b: a + b,
    "sub": lambda a, b: a - b,
    "mul": lambda a, b: a * b,
    "div": lambda a, b: float(np.float64(a) / b),
    "neg": lambda a: -a,
}


@dataclass
class CTranslation(Translation[np.ndarray]):
    """Translates the body of one function; `tables` are shared by all functions of a file."""

    language: ClassVar[str] = "C"
    operations: ClassVar[tuple[str, ...]] = (*OPERATIONS, *IDENTITY, "add_any", "integer_pow", "clamp")
    tables: Tables
    steps: list[Step] = field(default_factory=list)
    _written: dict[Any, Entry] = field(default_factory=dict)  # (operation, operands) → what holds its result

    def known(self, array):
        return column(value.item() if value.dtype == bool else float(value) for value in np.asarray(array).ravel())

    def join(self, columns):
        return np.concatenate([np.asarray(one, object) for one in columns])

    def take(self, column, places):
        return column[list(places)]

    def entrywise(self, name, columns, shape, exponent=0):
        name = "add" if name == "add_any" else name
        if name in IDENTITY or (name == "convert_element_type" and not any(map(_is_logical, columns[0]))):
            return columns[0]
        if name == "clamp":
            low, value, high = columns
            return self.entrywise("min", (self.entrywise("max", (value, low), shape), high), shape)
        if name == "integer_pow":
            return self._power(columns[0], exponent, shape)
        size = max(map(len, columns))
        columns = [np.broadcast_to(one, size) for one in columns]
        done = [self._simple(name, operands) for operands in zip(*columns, strict=True)]
        count = sum(one is None for one in done)
        if count > EXPANDED and (loop := self._loop(name, columns, shape)) is not None:
            return loop
        if count > COPIED:
            columns = [self._compact(one, shape) for one in columns]
            if (loop := self._loop(name, columns, shape)) is not None:
                return loop
        pairs = zip(done, zip(*columns, strict=True), strict=True)
        return column(self._scalar(name, operands) if one is None else one for one, operands in pairs)

    def scan(self, equation, inputs):
        """Loop over rows; no iteration may need the result of another."""
        inner, count, shared = (equation.params[key] for key in ("jaxpr", "length", "num_consts"))
        if equation.params["num_carry"]:
            raise self._refusal(equation)
        counter, each = self.tables.name("n"), CTranslation(self.tables)
        rows = [self._row(value, counter, each) for value in inputs[shared:]]
        results = each.run(inner, [*inputs[:shared], *rows])
        outs, starts = [self.tables.name("r") for _ in results], count * np.cumsum([0, *map(len, results)])

        def fill(whole: str) -> Statement:
            places = zip(outs, starts, results, strict=False)
            rows = [Row(out, Address(whole, int(at)), len(one), counter, written=True) for out, at, one in places]
            return Loop(counter, count, (*rows, *each.body(results, outs)))

        parts = np.split(self._filled(int(starts[-1]), fill), starts[1:-1])
        shapes = (one.aval.shape for one in equation.outvars)  # pyright: ignore[reportAttributeAccessIssue]
        return [Entries(part, shape) for part, shape in zip(parts, shapes, strict=True)]

    def _row(self, value: Value, counter: str, each: "CTranslation") -> Entries:
        """Return the row of an array for each value of a counter."""
        entries, shape, name = self._column(value), value.shape[1:], self.tables.name("p")
        size, logical = int(np.prod(shape)), any(map(_is_logical, entries))
        start = loops.address(self.tables, self._gathered(entries))
        each.steps.append(Step(name, (Row(name, start, size, counter, logical),)))
        return Entries(column(Entry(name, i, logical) for i in range(size)), shape)

    def body(
        self, results: Sequence[np.ndarray], outs: Sequence[str], begins: Iterable[int] = repeat(0)
    ) -> tuple[Statement, ...]:
        """Generate the statements that fill arrays with results, from `begins` on."""
        end = self._end(results, outs, begins)
        return arranged(self.steps, names(tuple(end)), end)

    def _end(self, results: Sequence[np.ndarray], outs: Sequence[str], begins: Iterable[int]) -> list[Statement]:
        filled = zip(outs, results, begins, strict=False)
        return [one for out, result, begin in filled for one in loops.stores(out, result, begin)]

    def fold(self, name, rows):
        if len(rows) * len(rows[0]) > EXPANDED:
            shape = (len(rows[0]), len(rows))
            operand = loops.indexed(self.tables, self._compact(np.stack(rows, axis=1).ravel(), shape), shape)
            assert operand is not None  # contiguous
            return self._filled(len(rows[0]), lambda out: loops.folding(out, name, operand, shape))
        return reduce(lambda a, b: self.entrywise(name, (a, b), (len(a),)), rows)

    def matrix_product(self, left, right, sizes):
        m, k, n = sizes
        a, b = left.reshape(m, k), right.reshape(k, n)
        if ((a != 0.0).astype(int) @ (b != 0.0).astype(int)).sum() <= PRODUCTS:
            pairs = ([self._scalar("mul", pair) for pair in zip(one, other, strict=True)] for one in a for other in b.T)
            return column(reduce(lambda a, b: self._scalar("add", (a, b)), terms) for terms in pairs)
        if all(isinstance(one, float) for one in right) and ((b != 0.0).sum(axis=0) <= 1).all():  # a selection
            chosen = (b != 0.0).argmax(axis=0)
            factors = np.tile(b[chosen, np.arange(n)], m)
            return self.entrywise("mul", (a[:, chosen].ravel(), factors), (m, n))
        rows, columns = [i for i in range(m) if not is_zero(a[i])], [j for j in range(n) if not is_zero(b[:, j])]
        result = np.full((m, n), 0.0, object)
        result[np.ix_(rows, columns)] = self._loops(a[rows], b[:, columns])
        return result.ravel()

    def _loops(self, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """A B as loops."""
        (m, k), n = a.shape, b.shape[1]
        if m == 1 and n > 1 and loops.is_contiguous(b.T.ravel()):
            return self._loops(b.T, a.T).T
        given = [loops.address(self.tables, self._gathered(one.ravel(), one.shape)) for one in (a, b)]
        return self._filled(m * n, lambda out: Call("product", (*given, Address(out), m, k, n))).reshape(m, n)

    def _power(self, base: np.ndarray, exponent: int, shape) -> np.ndarray:
        if exponent < 0:
            return self.entrywise("div", (column([1.0]), self._power(base, -exponent, shape)), shape)
        if exponent > 4 or exponent == 0:
            return self.entrywise("pow", (base, column([float(exponent)])), shape)
        return reduce(lambda a, b: self.entrywise("mul", (a, b), shape), [base] * exponent)

    def _simple(self, name: str, operands: Sequence) -> Any:
        """Return the result if no operation is needed, else None."""
        if name in _NUMBERS and all(isinstance(one, float) for one in operands):
            return _NUMBERS[name](*operands)
        match name, *operands:
            # As in sparse linear algebra, zero times a value is zero, even if that value is not finite.
            case ("mul", 0.0, _) | ("mul", _, 0.0) | ("div", 0.0, Entry()):
                return 0.0
            case ("add", 0.0, other) | ("add" | "sub", other, 0.0) | ("mul", 1.0, other) | ("mul" | "div", other, 1.0):
                return other
            case ("select_n", bool(which), otherwise, chosen):
                return chosen if which else otherwise
            case ("select_n", _, otherwise, chosen) if otherwise == chosen:
                return chosen
        return self._written.get((name, *operands))

    def _scalar(self, name: str, operands: Sequence) -> Any:
        if (found := self._simple(name, operands)) is None:
            found = self._written[(name, *operands)] = Entry(self.tables.name("t"), None, name in LOGICAL)
            defined = Variable(found.name, Operation(name, tuple(operands)), found.logical)
            self.steps.append(Step(found.name, (defined,)))
        return found

    def _loop(self, name: str, columns: Sequence[np.ndarray], shape: tuple[int, ...]) -> np.ndarray | None:
        """Apply an operation to each entry in a loop; None if the entries of a column are not in order."""
        operands = [loops.indexed(self.tables, one, shape) for one in columns]
        known = tuple(one for one in operands if one is not None)
        if len(known) < len(operands):
            return None
        return self._mapped(Operation(name, known), shape, name in LOGICAL)

    def _mapped(self, value: Expression, shape: tuple[int, ...], logical: bool) -> np.ndarray:
        """Make a new array of this shape whose entries are a value that depends on their indices."""
        return self._filled(int(np.prod(shape)), lambda out: loops.mapping(out, value, shape), logical)

    def _gathered(self, entries: np.ndarray, shape: tuple[int, ...] | None = None) -> np.ndarray:
        """Make entries contiguous in one array, by copying if necessary."""
        if loops.is_contiguous(entries):
            return entries
        logical = any(map(_is_logical, entries))
        if shape is not None and (found := loops.indexed(self.tables, entries, shape)) is not None:
            return self._mapped(found, shape, logical)
        return self._filled(len(entries), lambda out: loops.stores(out, entries), logical)

    def _compact(self, entries: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
        """Make entries addressable in a loop; entries that repeat along an axis are copied once."""
        if loops.indexed(self.tables, entries, shape) is not None:
            return entries
        grid = entries.reshape(shape)
        for axis in range(grid.ndim):
            first = grid.take([0], axis)
            grid = first if (grid == first).all() else grid
        return np.broadcast_to(self._gathered(grid.ravel(), grid.shape).reshape(grid.shape), shape).ravel()

    def _filled(
        self, size: int, fill: Callable[[str], Statement | tuple[Statement, ...]], logical: bool = False
    ) -> np.ndarray:
        """Make a new array filled by the statements of `fill(name)`."""
        name = self.tables.name("a")
        code = fill(name)
        self.steps.append(Step(name, code if isinstance(code, tuple) else (code,), Array(name, size, logical)))
        return column(Entry(name, i, logical) for i in range(size))


def _is_logical(one: Any) -> bool:
    return isinstance(one, bool) or (isinstance(one, Entry) and one.logical)


def column(entries: Iterable[Any]) -> np.ndarray:
    listed = list(entries)
    made = np.empty(len(listed), object)
    made[:] = listed
    return made


def is_zero(entries: np.ndarray) -> bool:
    return all(isinstance(one, float) and one == 0 for one in entries)
