"""Walk a JAX program operation by operation to translate it into another language.

A value that does not depend on the arguments is a NumPy array. Any other value is a shape and a column of its entries
in row-major order; each language defines its columns (`Translation`).
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from functools import reduce
from typing import Any, ClassVar, Generic, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr, Jaxpr, JaxprEqn, Literal

Column = TypeVar("Column")


class Entries(NamedTuple):
    """A value that depends on the arguments."""

    column: Any
    shape: tuple[int, ...]


Value = np.ndarray | Entries


class Translation(ABC, Generic[Column]):
    """Operations of a program on the columns of a language."""

    language: ClassVar[str]
    operations: ClassVar[dict[str, Callable]]  # entry by entry, name → from columns, and the exponent of integer_pow

    @abstractmethod
    def known(self, array: np.ndarray) -> Column:
        """Make a column of numbers."""

    @abstractmethod
    def join(self, columns: Sequence[Column]) -> Column:
        """Concatenate columns."""

    @abstractmethod
    def take(self, column: Column, places: Sequence[int]) -> Column:
        """Select entries by index."""

    @abstractmethod
    def entrywise(self, name: str, columns: Sequence[Column], shape: tuple[int, ...], parameters: tuple) -> Column:
        """Apply an operation entrywise to columns of this shape, or of one entry."""

    @abstractmethod
    def fold(self, name: str, rows: Sequence[Column]) -> Column:
        """Reduce the rows entrywise by sum, product, maximum or minimum."""

    @abstractmethod
    def matrix_product(self, left: Column, right: Column, sizes: tuple[int, int, int]) -> Column:
        """Multiply A (m × k) by B (k × n), sizes (m, k, n)."""

    def scan(self, equation: JaxprEqn, inputs: list[Value]) -> list[Value]:
        """Apply one program to each of several arrays; unsupported by most languages here."""
        raise self._refusal(equation)

    def run(self, program: ClosedJaxpr, arguments: Sequence["Value"]) -> list[Column]:
        """Translate a program and return its results as columns; raise ValueError for an unknown operation."""
        return [self._column(value) for value in self._run(program.jaxpr, program.consts, arguments)]

    def _run(self, program: Jaxpr, constants: Sequence[Any], arguments: Sequence[Value]) -> list[Value]:
        values: dict[Any, Value] = dict(zip(program.constvars, map(np.asarray, constants), strict=True))
        values.update(zip(program.invars, arguments, strict=True))

        def read(atom) -> Value:
            return np.asarray(atom.val) if isinstance(atom, Literal) else values[atom]

        for equation in filter(lambda one: one.outvars, program.eqns):  # a derivative may leave calls of nothing
            results = self._results(equation, [read(atom) for atom in equation.invars])
            values.update(zip(equation.outvars, results, strict=True))
        return [read(atom) for atom in program.outvars]

    def _results(self, equation: JaxprEqn, inputs: list[Value]) -> list[Value]:
        name, shape = equation.primitive.name, tuple(equation.outvars[0].aval.shape)  # type: ignore
        if name in CALLS:
            inner = equation.params["jaxpr" if "jaxpr" in equation.params else "call_jaxpr"]
            closed = isinstance(inner, ClosedJaxpr)
            return self._run(inner.jaxpr if closed else inner, inner.consts if closed else (), inputs)
        if not any(isinstance(value, Entries) for value in inputs):
            return _evaluated(equation, inputs)
        if name in self.operations:
            return [Entries(self._entrywise(equation, inputs, shape), shape)]
        if name in MOVES:
            return self._moved(equation, inputs)
        if name in LINEAR:
            return [Entries(self._linear(equation, inputs), shape)]
        if name in FOLDS:
            return [Entries(self._folded(inputs[0], equation.params["axes"], name), shape)]
        if name == "scan":
            return self.scan(equation, inputs)
        if name == "dot_general":
            return [Entries(self._product(inputs[0], inputs[1], equation.params["dimension_numbers"]), shape)]
        raise self._refusal(equation)

    def _refusal(self, equation: JaxprEqn, why: str = "") -> ValueError:
        name = equation.primitive.name
        return ValueError(f"field: its operation {name!r}{why} has no counterpart in {self.language}")

    def _column(self, value: Value) -> Column:
        return value.column if isinstance(value, Entries) else self.known(np.asarray(value).ravel())

    def _entrywise(self, equation: JaxprEqn, inputs: list[Value], shape: tuple[int, ...]) -> Column:
        name, (first, *_) = equation.primitive.name, equation.invars
        if name in ("and", "or", "not") and first.aval.dtype != bool:  # type: ignore
            raise self._refusal(equation, " of integers")
        if name == "select_n" and len(inputs) != 3:
            raise self._refusal(equation, f" of {len(inputs) - 1} cases")
        if name == "convert_element_type" and not jnp.issubdtype(equation.params["new_dtype"], jnp.floating):
            raise self._refusal(equation, f" to {equation.params['new_dtype']}")
        parameters = (equation.params["y"],) if name == "integer_pow" else ()
        return self.entrywise(name, [self._spread(value, shape) for value in inputs], shape, parameters)

    def _spread(self, value: Value, shape: tuple[int, ...]) -> Column:
        """Broadcast a value to a shape as in NumPy; single entries stay single."""
        column = self._column(value)
        if value.shape == shape or np.prod(value.shape) == 1:
            return column
        return self.take(column, np.broadcast_to(_places(value), shape).ravel().tolist())

    def _moved(self, equation: JaxprEqn, inputs: list[Value]) -> list[Value]:
        """Translate operations that only move entries, by applying them to indices in JAX."""
        columns, sent, count = [], list(inputs), 0
        for i in MOVES[equation.primitive.name](len(inputs)):
            places = _places(inputs[i])
            columns.append(self._column(inputs[i]))
            sent[i] = (count + places).astype(float)  # of the type of the entries, which JAX checks
            count += places.size
        if any(isinstance(value, Entries) for value in sent):
            raise self._refusal(equation, " at a place that depends on x or u")
        column = self.join(columns)

        def entries(places: np.ndarray) -> Value:
            if not np.isfinite(places).all():
                raise self._refusal(equation, " beyond the end of an array")
            return Entries(self.take(column, places.astype(int).ravel().tolist()), places.shape)

        return [entries(places) for places in _evaluated(equation, sent)]

    def _linear(self, equation: JaxprEqn, inputs: list[Value]) -> Column:
        """Translate operations that are linear in their data, as a matrix times each column."""
        data = LINEAR[equation.primitive.name]
        if any(isinstance(value, Entries) for i, value in enumerate(inputs) if i not in data):
            raise self._refusal(equation, " at a place that depends on x or u")
        zeros = [jnp.zeros(value.shape) if i in data else jnp.asarray(value) for i, value in enumerate(inputs)]

        def part(i: int) -> Column:
            def of_one(entries):
                return equation.primitive.bind(*zeros[:i], entries, *zeros[i + 1 :], **equation.params).ravel()

            matrix = np.asarray(jax.jacfwd(of_one)(zeros[i])).reshape(-1, zeros[i].size)
            return self.matrix_product(self.known(matrix.ravel()), self._column(inputs[i]), (*matrix.shape, 1))

        shape = tuple(equation.outvars[0].aval.shape)  # type: ignore
        return reduce(lambda a, b: self.entrywise("add", (a, b), shape, ()), map(part, data))

    def _folded(self, value: Value, axes: Sequence[int], name: str) -> Column:
        places = np.moveaxis(_places(value), axes, range(len(axes)))
        rows = places.reshape(int(np.prod(places.shape[: len(axes)])), -1)
        column = self._column(value)
        return self.fold(FOLDS[name], [self.take(column, row.tolist()) for row in rows])

    def _product(self, left: Value, right: Value, dimension_numbers) -> Column:
        """dot_general: the result's axes are the batch axes, then the left's, then the right's."""
        (of_left, of_right), (common_left, common_right) = dimension_numbers
        rows, m, k = self._matrices(left, of_left, common_left, last=True)
        columns, n, _ = self._matrices(right, of_right, common_right, last=False)
        return self.join([self.matrix_product(a, b, (m, k, n)) for a, b in zip(rows, columns, strict=True)])

    def _matrices(self, value: Value, contracted, common, last: bool) -> tuple[list[Column], int, int]:
        """Return a matrix per batch index, contracted axes last or first, and the sizes of its axes."""
        free = [axis for axis in range(len(value.shape)) if axis not in (*contracted, *common)]
        inner = (*free, *contracted) if last else (*contracted, *free)
        batches, m, k = (int(np.prod([value.shape[axis] for axis in axes])) for axes in (common, free, contracted))
        places = np.transpose(_places(value), (*common, *inner)).reshape(batches, m * k)
        column = self._column(value)
        return [self.take(column, one.tolist()) for one in places], m, k


def _evaluated(equation: JaxprEqn, inputs: Sequence[Any]) -> list[Any]:
    """Evaluate an operation on numbers, with NumPy if frequent, because JAX compiles each call."""
    if (move := _BY_NUMPY.get(equation.primitive.name)) is not None:
        return [move(equation.params, *map(np.asarray, inputs))]
    found = equation.primitive.bind(*map(jnp.asarray, inputs), **equation.params)
    return [np.asarray(one) for one in (found if equation.primitive.multiple_results else [found])]


def _sliced(params, a: np.ndarray) -> np.ndarray:
    strides = params["strides"] or (1,) * a.ndim
    return a[tuple(map(slice, params["start_indices"], params["limit_indices"], strides))]


def _broadcast(params, a: np.ndarray) -> np.ndarray:
    shape = params["shape"]
    aligned = [1] * len(shape)
    for axis, size in zip(params["broadcast_dimensions"], a.shape, strict=True):
        aligned[axis] = size
    return np.broadcast_to(a.reshape(aligned), shape)


def _padded(params, a: np.ndarray, value: np.ndarray) -> np.ndarray:
    pads = params["padding_config"]
    if any(low < 0 or high < 0 for low, high, _ in pads):
        return np.asarray(jax.lax.pad(a, value, pads))
    lengths = [size + inner * max(size - 1, 0) for (*_, inner), size in zip(pads, a.shape, strict=True)]
    sizes = [low + length + high for (low, high, _), length in zip(pads, lengths, strict=True)]
    made, places = np.full(sizes, value, np.result_type(a, value)), zip(pads, lengths, strict=True)
    made[tuple(slice(low, low + length, inner + 1) for (low, _, inner), length in places)] = a
    return made


_BY_NUMPY: dict[str, Callable[..., np.ndarray]] = {
    "slice": _sliced,
    "broadcast_in_dim": _broadcast,
    "squeeze": lambda params, a: a.squeeze(params["dimensions"]),
    "reshape": lambda params, a: a.reshape(params["new_sizes"]),
    "transpose": lambda params, a: a.transpose(params["permutation"]),
    "pad": _padded,
    "concatenate": lambda params, *parts: np.concatenate(parts, params["dimension"]),
}


def _places(value: Value) -> np.ndarray:
    """Return the index in its column of each entry, in the value's shape."""
    return np.arange(int(np.prod(value.shape))).reshape(value.shape)


# Operations that call another program. Custom derivatives are replaced by those of the language.
CALLS = ("jit", "closed_call", "remat2", "custom_jvp_call", "custom_vjp_call")
_ONE_OPERAND = (
    *("reshape", "squeeze", "expand_dims", "transpose", "rev", "tile", "split", "unstack", "slice", "gather"),
    *("broadcast_in_dim", "dynamic_slice"),
)
# Name → from the number of inputs, the indices of those whose entries are moved.
MOVES: dict[str, Callable[[int], Sequence[int]]] = {
    **dict.fromkeys(_ONE_OPERAND, lambda count: (0,)),
    **dict.fromkeys(("concatenate", "stack", "pad"), range),
    "dynamic_update_slice": lambda count: (0, 1),
    "scatter": lambda count: (0, 2),
}
LINEAR = {"scatter-add": (0, 2), "cumsum": (0,)}
FOLDS = {"reduce_sum": "add", "reduce_prod": "mul", "reduce_max": "max", "reduce_min": "min"}
