"""Translate JAX programs into C99: a few entries as expressions, simplified at zeros and ones, many as loops.

A column is a NumPy array of objects: numbers (floats or bools), and `Entry` for computed values. Sparse Jacobians of
physics become straight-line code, and network layers become loops over tables and arrays.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import reduce
from itertools import repeat
from typing import Any, ClassVar

import numpy as np
from jax.extend.core import ClosedJaxpr

from hybrid_jax.codegen import loops, nodes
from hybrid_jax.codegen.loops import Tables
from hybrid_jax.codegen.nodes import Address, Array, Call, Entry, Expression, Function, Operation, Statement, Step
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

    def _results(self, equation, inputs):
        if (function := self.tables.functions.get(equation.params.get("name", ""))) is None:
            return super()._results(equation, inputs)
        given = [self._address(self._column(value)) for value in inputs if np.prod(value.shape)]
        whole, places = self.tables.name("a"), _places(one.size for one in function.outputs)
        call = Call(function.name, (*given, *(Address(whole, at) for at in places[:-1])))
        self.steps.append(Step(whole, (call,), Array(whole, places[-1])))
        return _values(whole, places, equation.outvars)

    def scan(self, equation, inputs):
        """Call a function for each row in a loop; the first results of a call are inputs of the next."""
        inner, rows, shared, carried = (equation.params[key] for key in ("jaxpr", "length", "num_consts", "num_carry"))
        if equation.params["reverse"]:
            raise self._refusal(equation, " from the end")
        whole = self.tables.name("a")  # what is carried, as much of the next call, and the results of all rows
        begin = self.join([column([]), *map(self._column, inputs[shared : shared + carried])])
        inside, given = self._passed(inputs, shared, carried, whole)
        outs = [self.tables.name("r") for _ in equation.outvars]
        function = define(self.tables, self.tables.name("f"), inner, inside, outs)
        sizes = [one.size for one in function.outputs]
        places = _places([*sizes[:carried], *sizes[:carried], *(rows * size for size in sizes[carried:])])
        given += [Address(whole, at) for at in places[carried : 2 * carried]]
        given += [Address(whole, places[carried + i], steps=(sizes[i],)) for i in range(carried, len(sizes))]
        entry = Entry(whole, 0, steps=(0, 1))
        again = nodes.Loop("i1", len(begin), (nodes.Assign(entry, replace(entry, index=len(begin))),))
        loop = nodes.nested((rows,), Call(function.name, tuple(given)), *[again][:carried])
        self.steps.append(Step(whole, (*loops.stores(whole, begin), loop), Array(whole, places[-1])))
        del places[carried : 2 * carried]
        return _values(whole, places, equation.outvars)

    def _passed(
        self, inputs: Sequence[Value], shared: int, carried: int, whole: str
    ) -> tuple[list[Value], list[Address]]:
        """Return the inputs of the function in a loop as it sees them, and where its arrays begin in each call."""
        inside, given, at = list(inputs), list[Address](), 0
        for i, value in enumerate(inputs):
            if i < shared and isinstance(value, np.ndarray):
                continue  # numbers are a part of the function
            shape = value.shape[int(i >= shared + carried) :]
            if shared <= i < shared + carried:
                start, at = Address(whole, at), at + int(np.prod(shape))
            else:
                steps = (int(np.prod(shape)),) * (i >= shared + carried)
                start = replace(self._address(self._column(value)), steps=steps)
            inside[i] = entries(self.tables.name("p"), shape, logical=start.logical)
            given.append(start)
        return inside, given

    def _address(self, entries: np.ndarray, shape: tuple[int, ...] | None = None) -> Address:
        """Return where the entries begin, which are copied unless they are contiguous."""
        return loops.address(self.tables, self._gathered(entries, shape))

    def body(
        self, results: Sequence[np.ndarray], outs: Sequence[str], begins: Iterable[int] = repeat(0)
    ) -> tuple[Statement, ...]:
        """Generate the statements that fill arrays with results, from `begins` on."""
        end = self._end(results, outs, begins)
        return nodes.arranged(self.steps, nodes.names(tuple(end)), end)

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
        if m == 1 and n > 1:
            return self._loops(b.T, a.T).T
        matrix = loops.indexed(self.tables, a.ravel(), a.shape)
        if isinstance(matrix, Entry) and matrix.steps:
            start, steps = Address(matrix.name, matrix.index), matrix.steps
        else:
            start, steps = self._address(a.ravel()), (k, 1)
        given = start, *steps, self._address(b.ravel(), b.shape)
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
            defined = nodes.Variable(found.name, Operation(name, tuple(operands)), found.logical)
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


def entries(name: str, shape: Sequence[int], begin: int = 0, logical: bool = False) -> Entries:
    """Return the entries of an array, from `begin` on, as a value of this shape."""
    return Entries(column(Entry(name, begin + i, logical) for i in range(int(np.prod(shape)))), tuple(shape))


def define(
    tables: Tables, name: str, program: ClosedJaxpr, arguments: Sequence[Value], outputs: Sequence[str]
) -> Function:
    """Translate a program into a function of a file; its inputs are the arguments that are entries of an array."""
    translation = CTranslation(tables)
    results = translation.run(program, arguments)
    firsts = ((one.column[0], len(one.column)) for one in arguments if isinstance(one, Entries) and len(one.column))
    made = Function(
        name,
        tuple(Array(first.name, size, first.logical) for first, size in firsts),
        tuple(Array(key, len(one)) for key, one in zip(outputs, results, strict=True)),
        translation.body(results, outputs),
    )
    tables.functions[called(name)] = made
    return made


def _values(array: str, places: Sequence[int], outs: Sequence[Any]) -> list[Value]:
    """Return the results of an operation, which begin at these places of an array."""
    return [entries(array, one.aval.shape, at) for at, one in zip(places, outs, strict=False)]


def _places(sizes: Iterable[int]) -> list[int]:
    """Return where each part of an array begins, and the end."""
    return np.cumsum([0, *sizes]).tolist()


def called(name: str) -> str:
    """Return the name that a jitted function has which is translated to a call of a file's function."""
    return f"C {name}"  # no name of Python


def is_zero(entries: np.ndarray) -> bool:
    return all(isinstance(one, float) and one == 0 for one in entries)
