"""Walk a JAX program operation by operation to translate it into another language.

Every value is a NumPy array of its shape. If it depends on the arguments, its entries are objects: numbers, and
expressions of the language.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Container, Sequence
from functools import partial, reduce
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr, Jaxpr, JaxprEqn, Literal


class Translation(ABC):
    """Translates a program, operation by operation, into a language."""

    language: ClassVar[str]
    operations: ClassVar[Container[str]]  # supported operations on numbers, named as in JAX

    @abstractmethod
    def scalar(self, name: str, *operands: Any) -> Any:
        """Apply one of the operations to numbers."""

    def entrywise(self, name: str, *arrays: np.ndarray) -> np.ndarray:
        """Apply one of the operations to the entries of arrays that broadcast as in NumPy."""
        return applied(partial(self.scalar, name), *arrays)

    def fold(self, name: str, rows: np.ndarray) -> np.ndarray:
        """Reduce along the first axis by sum, product, maximum or minimum."""
        return reduce(partial(self.entrywise, name), rows)

    @abstractmethod
    def matrix_product(self, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """Multiply A (m × k) by B (k × n)."""

    def scan(self, equation: JaxprEqn, inputs: list[np.ndarray]) -> list[np.ndarray]:
        """Apply a program to each row of arrays; by default unsupported."""
        raise self._unsupported(equation)

    def run(self, program: ClosedJaxpr, arguments: Sequence[np.ndarray]) -> list[np.ndarray]:
        """Translate a program and return its results; raise ValueError for an unknown operation."""
        return list(map(objects, self._run(program.jaxpr, program.consts, arguments)))

    def _run(self, program: Jaxpr, constants: Sequence[Any], arguments: Sequence[np.ndarray]) -> list[np.ndarray]:
        values: dict[Any, np.ndarray] = dict(zip(program.constvars, map(np.asarray, constants), strict=True))
        values.update(zip(program.invars, arguments, strict=True))

        def read(atom) -> np.ndarray:
            return np.asarray(atom.val) if isinstance(atom, Literal) else values[atom]

        for equation in filter(lambda one: one.outvars, program.eqns):  # derivatives may contain calls without results
            results = self._results(equation, [read(atom) for atom in equation.invars])
            values.update(zip(equation.outvars, results, strict=True))
        return [read(atom) for atom in program.outvars]

    def _results(self, equation: JaxprEqn, inputs: list[np.ndarray]) -> list[np.ndarray]:
        name = equation.primitive.name
        if name in CALLS:
            inner = equation.params["jaxpr" if "jaxpr" in equation.params else "call_jaxpr"]
            closed = isinstance(inner, ClosedJaxpr)
            return self._run(inner.jaxpr if closed else inner, inner.consts if closed else (), inputs)
        if not any(map(depends, inputs)):
            return _evaluated(equation, inputs)
        if name in MOVES:
            return self._moved(equation, inputs)
        if name == "scan":
            return self.scan(equation, inputs)
        if name in COMPOSED:
            return [COMPOSED[name](self.entrywise, equation.params, *map(objects, inputs))]
        if name in self.operations:
            return [self._entrywise(equation, inputs)]
        if name in LINEAR:
            return [self._linear(equation, inputs)]
        if name in FOLDS:
            rows = np.moveaxis(objects(inputs[0]), axes := equation.params["axes"], range(len(axes)))
            shape = rows.shape[len(axes) :]
            return [self.fold(FOLDS[name], rows.reshape(-1, int(np.prod(shape)))).reshape(shape)]
        if name == "dot_general":
            return [self._product(equation.params["dimension_numbers"], *map(objects, inputs))]
        raise self._unsupported(equation)

    def _unsupported(self, equation: JaxprEqn, why: str = "") -> ValueError:
        name = equation.primitive.name
        return ValueError(f"field: its operation {name!r}{why} has no counterpart in {self.language}")

    def _entrywise(self, equation: JaxprEqn, inputs: list[np.ndarray]) -> np.ndarray:
        name, first = equation.primitive.name, equation.invars[0].aval.dtype  # type: ignore
        if name in ("and", "or", "not") and first.kind != "b":
            raise self._unsupported(equation, " of integers")
        if name == "select_n" and len(inputs) != 3:
            raise self._unsupported(equation, f" of {len(inputs) - 1} cases")
        if name == "convert_element_type":
            if not jnp.issubdtype(equation.params["new_dtype"], jnp.floating):
                raise self._unsupported(equation, f" to {equation.params['new_dtype']}")
            if first.kind != "b":
                return inputs[0]
        return self.entrywise(name, *map(objects, inputs))

    def _moved(self, equation: JaxprEqn, inputs: list[np.ndarray]) -> list[np.ndarray]:
        """Translate operations that only move entries, by applying them to indices in JAX."""
        entries, sent = list[Any](), list(inputs)
        for i in range(len(inputs))[MOVES[equation.primitive.name]]:
            places = len(entries) + np.arange(inputs[i].size, dtype=float)  # JAX checks that the type is the same
            sent[i] = places.reshape(inputs[i].shape)
            entries += objects(inputs[i]).ravel().tolist()
        if any(map(depends, sent)):
            raise self._unsupported(equation, " at a place that depends on x or u")
        moved, all_of_them = _evaluated(equation, sent), array_of(entries)
        if not all(np.isfinite(places).all() for places in moved):
            raise self._unsupported(equation, " beyond the end of an array")
        return [all_of_them[places.astype(int).ravel()].reshape(places.shape) for places in moved]

    def _linear(self, equation: JaxprEqn, inputs: list[np.ndarray]) -> np.ndarray:
        """Translate operations that are linear in their data to products with matrices."""
        data = LINEAR[equation.primitive.name]
        if any(depends(value) for i, value in enumerate(inputs) if i not in data):
            raise self._unsupported(equation, " at a place that depends on x or u")
        zeros = [jnp.zeros(value.shape) if i in data else jnp.asarray(value) for i, value in enumerate(inputs)]

        def part(i: int) -> np.ndarray:
            def of_one(entries):
                return equation.primitive.bind(*zeros[:i], entries, *zeros[i + 1 :], **equation.params).ravel()

            matrix = np.asarray(jax.jacfwd(of_one)(zeros[i])).reshape(-1, zeros[i].size)
            return self.matrix_product(objects(matrix), objects(inputs[i]).reshape(-1, 1))

        return reduce(partial(self.entrywise, "add"), map(part, data)).reshape(equation.outvars[0].aval.shape)  # type: ignore

    def _product(self, dimension_numbers, left: np.ndarray, right: np.ndarray) -> np.ndarray:
        """Translate dot_general, whose result has the batch axes, then the left's, then the right's."""
        (of_left, of_right), (common_left, common_right) = dimension_numbers
        rows, free = _matrices(left, of_left, common_left)
        columns, others = _matrices(right, of_right, common_right)
        products = [self.matrix_product(a, b.T) for a, b in zip(rows, columns, strict=True)]
        return np.reshape(products, (*(left.shape[axis] for axis in common_left), *free, *others))


def _matrices(value: np.ndarray, contracted: Sequence[int], common: Sequence[int]) -> tuple[np.ndarray, list[int]]:
    """Return a matrix per batch index, with contracted axes last, and the sizes of the other axes."""
    free = [axis for axis in range(value.ndim) if axis not in (*contracted, *common)]
    batches, m, k = (int(np.prod([value.shape[axis] for axis in axes])) for axes in (common, free, contracted))
    matrices = value.transpose((*common, *free, *contracted)).reshape(batches, m, k)
    return matrices, [value.shape[axis] for axis in free]


def depends(value: np.ndarray) -> bool:
    """Whether a value depends on the arguments."""
    return value.dtype == object


def objects(value: np.ndarray) -> np.ndarray:
    """Return a value as objects: floats, and bools."""
    return value if depends(value) else (value if value.dtype == bool else value.astype(float)).astype(object)


def array_of(entries: Sequence[Any]) -> np.ndarray:
    made = np.empty(len(entries), object)
    made[:] = entries
    return made


def applied(function: Callable, *arrays: np.ndarray) -> np.ndarray:
    """Apply a function of objects entry by entry to arrays that broadcast."""
    shape = np.broadcast_shapes(*(one.shape for one in arrays))
    return np.frompyfunc(function, len(arrays), 1)(*map(np.atleast_1d, arrays)).reshape(shape)


def _evaluated(equation: JaxprEqn, inputs: Sequence[Any]) -> list[Any]:
    """Evaluate an operation on numbers. Frequent ones use NumPy, because JAX would compile each."""
    inputs = list(map(np.asarray, inputs))
    params, shape = equation.params, equation.outvars[0].aval.shape  # type: ignore
    match equation.primitive.name:
        case "reshape" | "squeeze" | "expand_dims":
            return [inputs[0].reshape(shape)]
        case "transpose":
            return [inputs[0].transpose(params["permutation"])]
        case "broadcast_in_dim":
            added = [axis for axis in range(len(shape)) if axis not in params["broadcast_dimensions"]]
            return [np.broadcast_to(np.expand_dims(inputs[0], added), shape)]
        case "slice":
            bounds = params["start_indices"], params["limit_indices"], params["strides"] or (1,) * len(shape)
            return [inputs[0][tuple(map(slice, *bounds))]]
        case "split":
            return np.split(inputs[0], np.cumsum(params["sizes"])[:-1], params["axis"])
        case "concatenate":
            return [np.concatenate(inputs, params["dimension"])]
    found = equation.primitive.bind(*map(jnp.asarray, inputs), **params)
    return [np.asarray(one) for one in (found if equation.primitive.multiple_results else [found])]


# Operations that call another program. The language differentiates by itself, so custom derivatives are ignored.
CALLS = ("jit", "closed_call", "remat2", "custom_jvp_call", "custom_vjp_call")
_OF_ONE = (
    *("reshape", "squeeze", "expand_dims", "transpose", "rev", "tile", "split", "unstack", "slice", "gather"),
    *("broadcast_in_dim", "dynamic_slice"),
)
# Name → the inputs whose entries are moved.
MOVES = {
    **dict.fromkeys(_OF_ONE, slice(1)),
    **dict.fromkeys(("concatenate", "stack", "pad"), slice(None)),
    "dynamic_update_slice": slice(2),
    "scatter": slice(0, None, 2),
}
LINEAR = {"scatter-add": (0, 2), "cumsum": (0,)}
FOLDS = {"reduce_sum": "add", "reduce_prod": "mul", "reduce_max": "max", "reduce_min": "min"}


def _power(of: Callable, params: dict, base: np.ndarray) -> np.ndarray:
    exponent, number = abs(params["y"]), lambda a: objects(np.array(a))
    written_out = 0 < exponent < 5
    power = reduce(partial(of, "mul"), [base] * exponent) if written_out else of("pow", base, number(exponent))
    return of("div", number(1), power) if params["y"] < 0 else power


# Name → its definition by other operations, which the first argument applies.
COMPOSED: dict[str, Callable[..., np.ndarray]] = {
    **dict.fromkeys(("copy", "copy_p", "stop_gradient"), lambda of, params, a: a),
    "add_any": lambda of, params, a, b: of("add", a, b),
    "clamp": lambda of, params, low, a, high: of("min", of("max", a, low), high),
    "integer_pow": _power,
}
