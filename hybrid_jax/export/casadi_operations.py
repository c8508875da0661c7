"""Translate JAX programs into CasADi expressions, operation by operation.

A value that does not depend on the symbols is a NumPy array. One that does is a column of its entries, in row-major
order, and its shape.
"""

from collections.abc import Callable, Sequence
from functools import reduce
from operator import add, eq, ge, gt, le, lt, mul, ne, neg, pow, sub, truediv
from typing import Any, NamedTuple

import casadi as ca
import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr, Jaxpr, JaxprEqn, Literal


class Entries(NamedTuple):
    """A value that depends on the symbols."""

    column: "Column"
    shape: tuple[int, ...]


Value = np.ndarray | Entries
Column = ca.SX | ca.DM


def evaluate(program: ClosedJaxpr, symbols: Sequence[ca.SX]) -> ca.SX:
    """The result of a program from vectors to one vector, as a dense column; ValueError for an unknown operation."""
    (result,) = _run(program.jaxpr, program.consts, [Entries(one, (one.numel(),)) for one in symbols])
    return ca.densify(ca.SX(_column(result)))


def _run(program: Jaxpr, constants: Sequence[Any], arguments: Sequence[Value]) -> list[Value]:
    values: dict[Any, Value] = dict(zip(program.constvars, map(np.asarray, constants), strict=True))
    values.update(zip(program.invars, arguments, strict=True))

    def read(atom) -> Value:
        return np.asarray(atom.val) if isinstance(atom, Literal) else values[atom]

    for equation in program.eqns:
        results = _results(equation, [read(atom) for atom in equation.invars])
        values.update(zip(equation.outvars, results, strict=True))
    return [read(atom) for atom in program.outvars]


def _results(equation: JaxprEqn, inputs: list[Value]) -> list[Value]:
    name, shape = equation.primitive.name, tuple(equation.outvars[0].aval.shape)  # type: ignore
    if name in CALLS:
        inner = equation.params["jaxpr" if "jaxpr" in equation.params else "call_jaxpr"]
        return _run(inner.jaxpr, inner.consts, inputs) if isinstance(inner, ClosedJaxpr) else _run(inner, (), inputs)
    if not any(isinstance(value, Entries) for value in inputs):
        return _known(equation, inputs)
    if name in ENTRYWISE:
        return [Entries(_entrywise(equation, [_spread(value, shape) for value in inputs]), shape)]
    if name in MOVES:
        return _moved(equation, inputs)
    if name in LINEAR:
        return [Entries(_linear(equation, inputs), shape)]
    if name in FOLDS:
        return [Entries(_folded(inputs[0], equation.params["axes"], FOLDS[name]), shape)]
    if name == "dot_general":
        return [Entries(_product(inputs[0], inputs[1], equation.params["dimension_numbers"]), shape)]
    raise _refusal(equation)


def _known(equation: JaxprEqn, inputs: Sequence[Any]) -> list[Any]:
    """Evaluate an operation on numbers by JAX."""
    found = equation.primitive.bind(*map(jnp.asarray, inputs), **equation.params)
    return [np.asarray(one) for one in (found if equation.primitive.multiple_results else [found])]


def _refusal(equation: JaxprEqn, why: str = "") -> ValueError:
    return ValueError(f"field: its operation {equation.primitive.name!r}{why} has no counterpart in CasADi")


def _column(value: Value) -> Column:
    return value.column if isinstance(value, Entries) else ca.DM(np.asarray(value, float).reshape(-1, 1))


def _taken(column: Column, places: np.ndarray) -> Column:
    """The entries at these indices, as a column."""
    return column[places.ravel().tolist(), 0]


def _places(value: Value) -> np.ndarray:
    """The index in its column of each entry of a value, in the value's shape."""
    return np.arange(int(np.prod(value.shape))).reshape(value.shape)


def _spread(value: Value, shape: tuple[int, ...]) -> Column:
    """The column of a value broadcast to a shape, as in NumPy; CasADi broadcasts single entries itself."""
    column = _column(value)
    if value.shape == shape or column.numel() == 1:
        return column
    return _taken(column, np.broadcast_to(_places(value), shape))


def _moved(equation: JaxprEqn, inputs: list[Value]) -> list[Value]:
    """Operations that only move entries: JAX moves their indices, then the entries are taken at these."""
    columns, sent, count = [], list(inputs), 0
    for i in MOVES[equation.primitive.name](len(inputs)):
        places = _places(inputs[i])
        columns.append(_column(inputs[i]))
        sent[i] = (count + places).astype(float)  # of the type of the entries, which JAX checks
        count += places.size
    if any(isinstance(value, Entries) for value in sent):
        raise _refusal(equation, " at a place that depends on x or u")
    column = ca.vertcat(*columns)

    def entries(places: np.ndarray) -> Value:
        if not np.isfinite(places).all():
            raise _refusal(equation, " beyond the end of an array")
        return Entries(_taken(column, places.astype(int)), places.shape)

    return [entries(places) for places in _known(equation, sent)]


def _linear(equation: JaxprEqn, inputs: list[Value]) -> Column:
    """Operations that are linear in their data, as a matrix times each column."""
    data = LINEAR[equation.primitive.name]
    if any(isinstance(value, Entries) for i, value in enumerate(inputs) if i not in data):
        raise _refusal(equation, " at a place that depends on x or u")
    zeros = [jnp.zeros(value.shape) if i in data else jnp.asarray(value) for i, value in enumerate(inputs)]

    def part(i: int) -> Column:
        def of_one(entries):
            return equation.primitive.bind(*zeros[:i], entries, *zeros[i + 1 :], **equation.params).ravel()

        matrix = jax.jacfwd(of_one)(zeros[i]).reshape(-1, zeros[i].size)
        return ca.mtimes(ca.sparsify(ca.DM(np.asarray(matrix))), _column(inputs[i]))

    return reduce(lambda a, b: a + b, map(part, data))


def _folded(value: Value, axes: Sequence[int], fold: Callable) -> Column:
    places = np.moveaxis(_places(value), axes, range(len(axes)))
    rows = places.reshape(int(np.prod(places.shape[: len(axes)])), -1)
    column = _column(value)
    return reduce(fold, (_taken(column, row) for row in rows))


def _product(left: Value, right: Value, dimension_numbers) -> Column:
    """dot_general: the axes of the result are the batch axes, those of the left and those of the right."""
    (of_left, of_right), (common_left, common_right) = dimension_numbers
    rows, columns = _matrices(left, of_left, common_left), _matrices(right, of_right, common_right)
    # CasADi is column-major and JAX row-major, hence the transpose.
    return ca.vertcat(*(ca.vec(ca.mtimes(a, b.T).T) for a, b in zip(rows, columns, strict=True)))


def _matrices(value: Value, contracted: Sequence[int], common: Sequence[int]) -> list[Column]:
    """One matrix (free × contracted) for each index of the batch axes."""
    free = [axis for axis in range(len(value.shape)) if axis not in (*contracted, *common)]
    places = np.transpose(_places(value), (*common, *free, *contracted))
    sizes = [int(np.prod([value.shape[axis] for axis in axes])) for axes in (common, free, contracted)]
    column = _column(value)
    return [ca.reshape(_taken(column, one), sizes[2], sizes[1]).T for one in places.reshape(sizes)]


def _entrywise(equation: JaxprEqn, inputs: Sequence[Column]) -> Column:
    name, (first, *_) = equation.primitive.name, equation.invars
    if name in ("and", "or", "not") and first.aval.dtype != bool:  # type: ignore
        raise _refusal(equation, " of integers")
    if name == "select_n" and len(inputs) != 3:
        raise _refusal(equation, f" of {len(inputs) - 1} cases")
    if name == "convert_element_type" and not jnp.issubdtype(equation.params["new_dtype"], jnp.floating):
        raise _refusal(equation, f" to {equation.params['new_dtype']}")
    exponent = (equation.params["y"],) if name == "integer_pow" else ()
    return ENTRYWISE[name](*inputs, *exponent)


# Operations that call another program. Custom derivatives are replaced by CasADi's.
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
FOLDS = {"reduce_sum": add, "reduce_prod": mul, "reduce_max": ca.fmax, "reduce_min": ca.fmin}
_SAME_NAME = (
    *("sign", "floor", "ceil", "sqrt", "exp", "expm1", "log", "log1p", "erf", "atan2"),
    *("sin", "cos", "tan", "asin", "acos", "atan", "sinh", "cosh", "tanh", "asinh", "acosh", "atanh"),
)
ENTRYWISE: dict[str, Callable] = {
    **{name: getattr(ca, name) for name in _SAME_NAME},
    **dict.fromkeys(("copy", "copy_p", "stop_gradient", "convert_element_type"), lambda a: a),
    **{operation.__name__: operation for operation in (add, sub, mul, pow, neg, lt, le, gt, ge, eq, ne)},
    "add_any": add,
    "integer_pow": pow,
    "div": truediv,
    "rem": ca.fmod,
    "max": ca.fmax,
    "min": ca.fmin,
    "clamp": lambda low, a, high: ca.fmin(ca.fmax(a, low), high),
    "abs": ca.fabs,
    "square": lambda a: a * a,
    "rsqrt": lambda a: 1 / ca.sqrt(a),
    "exp2": lambda a: 2**a,
    "logistic": lambda a: 1 / (1 + ca.exp(-a)),
    "erfc": lambda a: 1 - ca.erf(a),
    "select_n": lambda which, otherwise, a: ca.if_else(which, a, otherwise),
    "and": ca.logic_and,
    "or": ca.logic_or,
    "not": ca.logic_not,
}
