"""Translate JAX programs into C99: a few entries as expressions, simplified at zeros and ones, many as loops.

A column is a NumPy array of objects: numbers (floats or bools), and `Entry` for computed values. Sparse Jacobians of
physics become straight-line code, and network layers become loops over tables and arrays.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from functools import reduce
from itertools import repeat
from typing import Any, ClassVar, NamedTuple

import numpy as np

from hybrid_jax.codegen import loops
from hybrid_jax.codegen.nodes import (
    Address,
    Array,
    Call,
    Entry,
    Expression,
    Operation,
    Parameter,
    Statement,
    Step,
    Variable,
    arranged,
    names,
    nested,
)
from hybrid_jax.codegen.printer import OPERATIONS
from hybrid_jax.codegen.tables import Tables
from hybrid_jax.codegen.translation import Entries, Translation, Value

EXPANDED = 24  # operations on at most so many entries are written out; more become a loop if they can
COPIED = 200  # and on at most so many if they cannot
PRODUCTS = 160  # multiplications of a matrix product that are written out

LOGICAL = ("lt", "le", "gt", "ge", "eq", "ne", "and", "or", "not")
IDENTITY = ("copy", "copy_p", "stop_gradient")
COMPOSED: dict[str, Callable[..., Operation]] = {
    "square": lambda a: Operation("mul", (a, a)),
    "rsqrt": lambda a: Operation("div", (1, Operation("sqrt", (a,)))),
    "logistic": lambda a: Operation("div", (1, Operation("add", (1, Operation("exp", (Operation("neg", (a,)),)))))),
    "sign": lambda a: Operation(
        "convert_element_type", (Operation("sub", (Operation("gt", (a, 0)), Operation("lt", (a, 0)))),)
    ),
}
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
    operations: ClassVar[dict[str, Callable]] = dict.fromkeys(
        (*OPERATIONS, *COMPOSED, *IDENTITY, "add_any", "integer_pow", "clamp"), lambda *_: None
    )
    tables: Tables
    steps: list[Step] = field(default_factory=list)
    _written: dict[Any, Entry] = field(default_factory=dict)  # (operation, operands) → what holds its result

    def known(self, array):
        return column(value.item() if value.dtype == bool else float(value) for value in np.asarray(array).ravel())

    def join(self, columns):
        return np.concatenate([np.asarray(one, object) for one in columns])

    def take(self, column, places):
        return column[list(places)]

    def entrywise(self, name, columns, shape, parameters):
        name = "add" if name == "add_any" else name
        if name in IDENTITY:
            return columns[0]
        if name == "clamp":
            low, value, high = columns
            value = self.entrywise("max", (value, low), shape, ())
            return self.entrywise("min", (value, high), shape, ())
        if name == "convert_element_type" and not any(self._is_logical(one) for one in columns[0]):
            return columns[0]
        if name == "integer_pow":
            return self._power(columns[0], parameters[0], shape)
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
        """Call a function of one array in a loop; no iteration may need the result of another."""
        inner, count, shared = (equation.params[key] for key in ("jaxpr", "length", "num_consts"))
        if equation.params["num_carry"]:
            raise self._refusal(equation)
        passed = [self._passed(value, value.shape, 0) for value in inputs[:shared]]
        passed += [self._passed(value, value.shape[1:], 1) for value in inputs[shared:]]
        called = CTranslation(self.tables)
        results = called.run(inner, [one.inside for one in passed])
        outs = [self.tables.name("r") for _ in results]
        body = called.body(results, outs)
        read = names(body)
        taken = [(one.parameter, one.given) for one in passed if one.parameter and one.parameter.name in read]
        written = [Parameter(out, array=True, written=True) for out in outs]
        name = self.tables.function([*(parameter for parameter, _ in taken), *written], body)

        starts = count * np.cumsum([0, *map(len, results)])

        def fill(out: str) -> Statement:
            pairs = zip(starts, results, strict=False)
            filled = (Address(out, int(start), (len(one),)) for start, one in pairs)
            return nested((count,), Call(name, (*(given for _, given in taken), *filled)))

        whole = self._filled(int(starts[-1]), fill)
        parts = zip(np.split(whole, starts[1:-1]), equation.outvars, strict=True)
        return [Entries(part, one.aval.shape) for part, one in parts]  # pyright: ignore[reportAttributeAccessIssue]

    def _passed(self, value: Value, shape: tuple[int, ...], stride: int) -> "_Passed":
        """Pass a value, or each array of this shape in it, to a function."""
        if not stride and not isinstance(value, Entries):
            return _Passed(value)  # a constant, which the function may as well have
        entries, size = self._column(value), int(np.prod(shape))
        name, logical = self.tables.name("p"), any(self._is_logical(one) for one in entries)
        if not stride and size == 1:
            inside = column([Entry(name, None, logical)])
            return _Passed(Entries(inside, shape), Parameter(name, logical), entries[0])
        inside = column(Entry(name, i, logical) for i in range(size))
        given = loops.address(self.tables, self._gathered(entries), stride * size)
        return _Passed(Entries(inside, shape), Parameter(name, logical, array=True), given)

    def body(
        self, results: Sequence[np.ndarray], outs: Sequence[str], begins: Iterable[int] = repeat(0)
    ) -> tuple[Statement, ...]:
        """Generate the statements that fill arrays with results, from `begins` on."""
        filled = zip(outs, results, begins, strict=False)
        end = [one for out, result, begin in filled for one in loops.stores(out, result, begin)]
        return arranged(self.steps, frozenset().union(*(names(tuple(one)) for one in results)), end)

    def fold(self, name, rows):
        if len(rows) * len(rows[0]) > EXPANDED:
            shape = (len(rows[0]), len(rows))
            whole = self._compact(np.stack(rows, axis=1).ravel(), shape)
            operand = loops.indexed(self.tables, whole, shape)
            assert operand is not None  # contiguous
            return self._filled(len(rows[0]), lambda out: loops.folding(out, name, operand, shape))
        return reduce(lambda a, b: self.entrywise(name, (a, b), (len(a),), ()), rows)

    def matrix_product(self, left, right, sizes):
        m, k, n = sizes
        a, b = left.reshape(m, k), right.reshape(k, n)
        rows, columns = [i for i in range(m) if not is_zero(a[i])], [j for j in range(n) if not is_zero(b[:, j])]
        both = (a != 0.0).astype(int) @ (b != 0.0).astype(int)
        if both.sum() <= PRODUCTS:
            return column(self._dot(one, other) for one in a for other in b.T)
        if all(isinstance(one, float) for one in right) and ((b != 0.0).sum(axis=0) <= 1).all():  # a selection
            chosen = (b != 0.0).argmax(axis=0)
            factors = np.tile(b[chosen, np.arange(n)], m)
            return self.entrywise("mul", (a[:, chosen].ravel(), factors), (m, n), ())
        result = np.full((m, n), 0.0, object)
        result[np.ix_(rows, columns)] = self._loops(a[rows], b[:, columns])
        return result.ravel()

    def _loops(self, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """A B as loops, for a matrix and a vector or for two matrices."""
        (m, k), n = a.shape, b.shape[1]
        if m == 1 and n > 1 and loops.is_contiguous(b.T.ravel()):
            return self._loops(b.T, a.T).T
        given = [loops.address(self.tables, self._gathered(one.ravel(), one.shape)) for one in (a, b)]
        function, sizes = ("dense", (m, k)) if n == 1 else ("product", (m, k, n))
        return self._filled(m * n, lambda out: Call(function, (*given, Address(out), *sizes))).reshape(m, n)

    def _dot(self, row: Iterable, other: Iterable):
        terms = [self._one("mul", pair) for pair in zip(row, other, strict=True)]
        return reduce(lambda a, b: self._one("add", (a, b)), terms)

    def _power(self, base: np.ndarray, exponent: int, shape) -> np.ndarray:
        if exponent < 0:
            return self.entrywise("div", (column([1.0]), self._power(base, -exponent, shape)), shape, ())
        if exponent > 4:
            return self.entrywise("pow", (base, column([float(exponent)])), shape, ())
        if exponent == 0:
            return column([1.0] * len(base))
        return reduce(lambda a, b: self.entrywise("mul", (a, b), shape, ()), [base] * exponent)

    def _one(self, name: str, operands: Sequence):
        simple = self._simple(name, operands)
        return self._scalar(name, operands) if simple is None else simple

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

    def _scalar(self, name: str, operands: Sequence) -> Entry:
        if (found := self._written.get((name, *operands))) is None:
            logical = name in LOGICAL
            found = Entry(self.tables.name("t"), None, logical)
            defined = Variable(found.name, _operation(name, operands), logical)
            self.steps.append(Step(found.name, (defined,)))
            self._written[(name, *operands)] = found
        return found

    def _loop(self, name: str, columns: Sequence[np.ndarray], shape: tuple[int, ...]) -> np.ndarray | None:
        """Apply an operation to each entry in a loop; None if the entries of a column are not in order."""
        operands = [loops.indexed(self.tables, one, shape) for one in columns]
        known = [one for one in operands if one is not None]
        if len(known) < len(operands):
            return None
        value = _operation(name, known)
        return self._filled(int(np.prod(shape)), lambda out: loops.mapping(out, value, shape), name in LOGICAL)

    def _gathered(self, entries: np.ndarray, shape: tuple[int, ...] | None = None) -> np.ndarray:
        """Make entries contiguous in one array, by copying if necessary."""
        if loops.is_contiguous(entries):
            return entries
        logical = any(self._is_logical(one) for one in entries)
        if shape is not None and (found := loops.indexed(self.tables, entries, shape)) is not None:
            return self._filled(len(entries), lambda out: loops.mapping(out, found, shape), logical)
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

    @staticmethod
    def _is_logical(one) -> bool:
        return isinstance(one, bool) or (isinstance(one, Entry) and one.logical)


class _Passed(NamedTuple):
    """A value inside a function and its argument, except for constants."""

    inside: Value
    parameter: Parameter | None = None
    given: Expression = 0.0


def _operation(name: str, operands: Sequence[Expression]) -> Operation:
    return COMPOSED[name](*operands) if name in COMPOSED else Operation(name, tuple(operands))


def column(entries: Iterable[Any]) -> np.ndarray:
    listed = list(entries)
    made = np.empty(len(listed), object)
    made[:] = listed
    return made


def is_zero(entries: np.ndarray) -> bool:
    return all(isinstance(one, float) and one == 0 for one in entries)
