"""Translate JAX programs into C99: few entries as expressions, simplified at zeros and ones, and many as loops.

Entries are numbers (floats or bools), or `Entry` for computed values. For example, sparse Jacobians of physics become
straight-line code, and network layers become loops over tables and arrays.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial, reduce
from itertools import repeat
from typing import Any, ClassVar

import numpy as np
from jax.extend.core import ClosedJaxpr

from hybrid_jax.codegen import loops, nodes
from hybrid_jax.codegen.loops import Tables
from hybrid_jax.codegen.nodes import Address, Array, Call, Entry, Expression, Function, Operation, Statement, Step
from hybrid_jax.codegen.printer import OPERATIONS
from hybrid_jax.codegen.translation import Translation, applied, array_of, depends, objects

EXPANDED = 24  # most entries for which an operation is written out if it could be a loop
COPIED = 200  # most entries if they would have to be copied for a loop
PRODUCTS = 160  # most multiplications of a matrix product that are written out

_NUMBERS: dict[str, Callable] = {
    "add": lambda a, b: a + b,
    "sub": lambda a, b: a - b,
    "mul": lambda a, b: a * b,
    "div": lambda a, b: float(np.float64(a) / b),
    "neg": lambda a: -a,
}


@dataclass
class CTranslation(Translation):
    """Translates the body of one function; `tables` are shared by all functions of a file."""

    language: ClassVar[str] = "C"
    operations: ClassVar[dict[str, str]] = OPERATIONS
    tables: Tables
    steps: list[Step] = field(default_factory=list)
    _written: dict[Any, Entry] = field(default_factory=dict)  # (operation, operands) → its result

    def scalar(self, name, *operands):
        if (found := self._simple(name, *operands)) is None:
            found = self._written[(name, *operands)] = Entry(self.tables.name("t"))
            self.steps.append(Step(found.name, (nodes.Variable(found.name, Operation(name, operands)),)))
        return found

    def _simple(self, name: str, *operands: Any) -> Any:
        """Return the result if no operation is needed, else None."""
        if name in _NUMBERS and all(isinstance(one, float) for one in operands):
            return _NUMBERS[name](*operands)
        match name, *operands:
            # As in sparse linear algebra, zero times any value is zero, even if it is not finite.
            case ("mul", 0.0, _) | ("mul", _, 0.0) | ("div", 0.0, Entry()):
                return 0.0
            case ("add", 0.0, other) | ("add" | "sub", other, 0.0) | ("mul", 1.0, other) | ("mul" | "div", other, 1.0):
                return other
            case ("select_n", bool(which), otherwise, chosen):
                return chosen if which else otherwise
            case ("select_n", _, otherwise, chosen) if otherwise == chosen:
                return chosen
        return self._written.get((name, *operands))

    def entrywise(self, name, *arrays):
        arrays = np.broadcast_arrays(*arrays)
        count = sum(one is None for one in applied(partial(self._simple, name), *arrays).flat)
        if count > EXPANDED and (loop := self._loop(name, arrays)) is not None:
            return loop
        if count > COPIED and (loop := self._loop(name, [self._compact(one) for one in arrays])) is not None:
            return loop
        return super().entrywise(name, *arrays)

    def _loop(self, name: str, arrays: Sequence[np.ndarray]) -> np.ndarray | None:
        """Apply an operation to each entry in a loop; None if the entries of an array are not in order."""
        operands = [loops.indexed(self.tables, one) for one in arrays]
        known = tuple(one for one in operands if one is not None)
        return self._mapped(Operation(name, known), arrays[0].shape) if len(known) == len(operands) else None

    def fold(self, name, rows):
        if rows.size <= EXPANDED:
            return super().fold(name, rows)
        operand = loops.indexed(self.tables, self._compact(rows.T))
        assert operand is not None  # contiguous
        return self._filled(rows.shape[1:], lambda out: loops.folding(out, name, operand, rows.T.shape))

    def matrix_product(self, a, b):
        shape = len(a), b.shape[1]
        if ((a != 0.0).astype(int) @ (b != 0.0).astype(int)).sum() <= PRODUCTS:
            add, multiply = (partial(self.scalar, name) for name in ("add", "mul"))
            terms = ([*map(multiply, row, column)] for row in a for column in b.T)
            return array_of([reduce(add, each) for each in terms]).reshape(shape)
        if all(isinstance(one, float) for one in b.flat) and ((b != 0.0).sum(axis=0) <= 1).all():  # a selection
            chosen = (b != 0.0).argmax(axis=0)
            return self.entrywise("mul", a[:, chosen], b[chosen, np.arange(shape[1])])
        rows, columns = ([i for i, row in enumerate(one) if not is_zero(row)] for one in (a, b.T))
        result = np.full(shape, 0.0, object)
        result[np.ix_(rows, columns)] = self._loops(a[rows], b[:, columns])
        return result

    def _loops(self, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        (m, k), n = a.shape, b.shape[1]
        if m == 1 and n > 1:
            return self._loops(b.T, a.T).T
        matrix = loops.indexed(self.tables, a)
        if isinstance(matrix, Entry) and matrix.steps:
            start, steps = Address(matrix.name, matrix.index), matrix.steps
        else:
            start, steps = self._address(a), (k, 1)
        given = start, *steps, self._address(b)
        return self._filled((m, n), lambda out: Call("product", (*given, Address(out), m, k, n)))

    def _results(self, equation, inputs):
        if (function := self.tables.functions.get(equation.params.get("name", ""))) is None:
            return super()._results(equation, inputs)
        given = [self._address(objects(value)) for value in inputs if value.size]
        whole, places = self.tables.name("a"), _places(one.size for one in function.outputs)
        call = Call(function.name, (*given, *(Address(whole, at) for at in places[:-1])))
        self.steps.append(Step(whole, (call,), Array(whole, places[-1])))
        return _values(whole, places, equation.outvars)

    def scan(self, equation, inputs):
        """Call a function for each row in a loop; the first results of a call are inputs of the next."""
        inner, rows, shared, carried = (equation.params[key] for key in ("jaxpr", "length", "num_consts", "num_carry"))
        if equation.params["reverse"]:
            raise self._unsupported(equation, " from the end")
        whole = self.tables.name("a")  # the carry, the next carry, and the results of all rows
        begin = np.concatenate([objects(one).ravel() for one in (np.zeros(0), *inputs[shared : shared + carried])])
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
        self, inputs: Sequence[np.ndarray], shared: int, carried: int, whole: str
    ) -> tuple[list[np.ndarray], list[Address]]:
        """Return the inputs of the function in a loop, and the addresses that each call passes for them."""
        inside, given, at = list(inputs), list[Address](), 0
        for i, value in enumerate(inputs):
            if i < shared and not depends(value):
                continue  # numbers become part of the function
            inside[i] = entries(self.tables.name("p"), value.shape[int(i >= shared + carried) :])
            if shared <= i < shared + carried:
                given.append(Address(whole, at))
                at += value.size
            else:
                steps = (inside[i].size,) * (i >= shared + carried)
                given.append(replace(self._address(objects(value)), steps=steps))
        return inside, given

    def body(
        self, results: Sequence[np.ndarray], outs: Sequence[str], begins: Iterable[int] = repeat(0)
    ) -> tuple[Statement, ...]:
        """Generate the statements that fill arrays with results, from `begins` on."""
        end = self._end(results, outs, begins)
        return nodes.arranged(self.steps, nodes.names(tuple(end)), end)

    def _end(self, results: Sequence[np.ndarray], outs: Sequence[str], begins: Iterable[int]) -> list[Statement]:
        filled = zip(outs, results, begins, strict=False)
        return [one for out, result, begin in filled for one in loops.stores(out, result.ravel(), begin)]

    def _address(self, array: np.ndarray) -> Address:
        """Return the address of entries, which are copied unless they are contiguous."""
        return loops.address(self.tables, array) or self._address(self._copied(array))

    def _compact(self, array: np.ndarray) -> np.ndarray:
        """Make entries addressable in a loop; entries that repeat along an axis are copied once."""
        if loops.indexed(self.tables, array) is not None:
            return array
        grid = array
        for axis in range(grid.ndim):
            first = grid.take([0], axis)
            grid = first if (grid == first).all() else grid
        return np.broadcast_to(self._copied(grid), array.shape)

    def _copied(self, array: np.ndarray) -> np.ndarray:
        """Make entries contiguous in one array."""
        if (found := loops.indexed(self.tables, array)) is not None:
            return self._mapped(found, array.shape)
        return self._filled(array.shape, lambda out: loops.stores(out, array.ravel()))

    def _mapped(self, value: Expression, shape: tuple[int, ...]) -> np.ndarray:
        """Make a new array of this shape whose entries are a value that depends on their indices."""
        return self._filled(shape, lambda out: loops.mapping(out, value, shape))

    def _filled(self, shape: tuple[int, ...], fill: Callable[[str], Statement | tuple[Statement, ...]]) -> np.ndarray:
        """Make a new array filled by the statements of `fill(name)`."""
        name = self.tables.name("a")
        made, code = entries(name, shape), fill(name)
        self.steps.append(Step(name, code if isinstance(code, tuple) else (code,), Array(name, made.size)))
        return made


def entries(name: str, shape: Sequence[int], begin: int = 0) -> np.ndarray:
    """Return the entries of an array from `begin` on, in this shape."""
    return array_of([Entry(name, begin + i) for i in range(int(np.prod(shape)))]).reshape(shape)


def define(
    tables: Tables, name: str, program: ClosedJaxpr, arguments: Sequence[np.ndarray], outputs: Sequence[str]
) -> Function:
    """Translate a program into a function of a file, whose inputs are the arguments that are not numbers."""
    translation = CTranslation(tables)
    results = translation.run(program, arguments)
    inputs = tuple(Array(one.flat[0].name, one.size) for one in arguments if depends(one) and one.size)
    sizes = tuple(Array(key, one.size) for key, one in zip(outputs, results, strict=True))
    made = tables.functions[called(name)] = Function(name, inputs, sizes, translation.body(results, outputs))
    return made


def _values(array: str, places: Sequence[int], outs: Sequence[Any]) -> list[np.ndarray]:
    """Return the results of an operation, which begin at these places of an array."""
    return [entries(array, one.aval.shape, at) for at, one in zip(places, outs, strict=False)]


def _places(sizes: Iterable[int]) -> list[int]:
    """Return where each part of an array begins, and the end."""
    return np.cumsum([0, *sizes]).tolist()


def called(name: str) -> str:
    """Return the name of jitted functions that are translated to a call of a file's function."""
    return f"C {name}"  # no Python function has such a name


def is_zero(entries: np.ndarray) -> bool:
    return all(isinstance(one, float) and one == 0 for one in entries.flat)
