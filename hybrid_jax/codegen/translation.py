"""Walk a JAX program operation by operation to translate it into another language.

A value that does not depend on the arguments is a NumPy array. Any other value is a shape and a column of its entries
in row-major order; each language defines its columns (`Translation`).
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Container, Sequence
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
    operations: ClassVar[Container[str]]  # that are applied entry by entry

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
    def entrywise(self, name: str, columns: Sequence[Column], shape: tuple[int, ...], exponent: int = 0) -> Column:
        """Apply an operation, of which integer_pow has an exponent, to columns of this shape, or of one entry."""

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
        if name in MOVES:
            return self._moved(equation, inputs)
        if name == "scan":
            return self.scan(equation, inputs)
        if name in self.operations:
            made = self._entrywise(equation, inputs, shape)
        elif name in LINEAR:
            made = self._linear(equation, inputs)
        elif name in FOLDS:
            made = self._folded(inputs[0], equation.params["axes"], FOLDS[name])
        elif name == "dot_general":
            made = self._product(inputs[0], inputs[1], equation.params["dimension_numbers"])
        else:
            raise self._refusal(equation)
        return [Entries(made, shape)]

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
        return self.entrywise(
            name, [self._spread(value, shape) for value in inputs], shape, equation.params.get("y", 0)
        )

    def _spread(self, value: Value, shape: tuple[int, ...]) -> Column:
        """Broadcast a value to a shape as in NumPy; single entries stay single."""
        column = self._column(value)
        if value.shape == shape or np.prod(value.shape) == 1:
            return column
        return self.take(column, np.broadcast_to(_places(value), shape).ravel().tolist())

    def _moved(self, equation: JaxprEqn, inputs: list[Value]) -> list[Value]:
        """Translate operations that only move entries, by applying them to indices in JAX."""
        columns, sent, count = [], list(inputs), 0
        for i in range(len(inputs))[MOVES[equation.primitive.name]]:
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
        return reduce(lambda a, b: self.entrywise("add", (a, b), shape), map(part, data))

    def _folded(self, value: Value, axes: Sequence[int], name: str) -> Column:
        places = np.moveaxis(_places(value), axes, range(len(axes)))
        rows = places.reshape(int(np.prod(places.shape[: len(axes)])), -1)
        column = self._column(value)
        return self.fold(name, [self.take(column, row.tolist()) for row in rows])

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


def _broadcast(params, a: np.ndarray) -> np.ndarray:
    added = [axis for axis in range(len(params["shape"])) if axis not in params["broadcast_dimensions"]]
    return np.broadcast_to(np.expand_dims(a, added), params["shape"])


def _padded(params, a: np.ndarray, value: np.ndarray) -> np.ndarray:
    pads = params["padding_config"]
    if any(low < 0 or high < 0 or inner for low, high, inner in pads):
        return np.asarray(jax.lax.pad(a, value, pads))
    return np.pad(a, [(low, high) for low, high, _ in pads], constant_values=value)


_BY_NUMPY: dict[str, Callable[..., np.ndarray]] = {
    "slice": lambda params, a: a[
        tuple(map(slice, params["start_indices"], params["limit_indices"], params["strides"] or (1,) * a.ndim))
    ],
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
_OF_ONE = (
    *("reshape", "squeeze", "expand_dims", "transpose", "rev", "tile", "split", "unstack", "slice", "gather"),
    *("broadcast_in_dim", "dynamic_slice"),
)
# Name → those of the inputs whose entries are moved.
MOVES = {
    **dict.fromkeys(_OF_ONE, slice(1)),
    **dict.fromkeys(("concatenate", "stack", "pad"), slice(None)),
    "dynamic_update_slice": slice(2),
    "scatter": slice(0, None, 2),
}
LINEAR = {"scatter-add": (0, 2), "cumsum": (0,)}
FOLDS = {"reduce_sum": "add", "reduce_prod": "mul", "reduce_max": "max", "reduce_min": "min"}
