"""Translate JAX programs into CasADi expressions."""

from collections.abc import Callable, Sequence
from functools import reduce
from operator import add, eq, ge, gt, le, lt, mul, ne, neg, pow, sub, truediv
from typing import ClassVar

import casadi as ca
import numpy as np
from jax.extend.core import ClosedJaxpr

from hybrid_jax.codegen.translation import Entries, Translation

Column = ca.SX | ca.DM


def evaluate(program: ClosedJaxpr, symbols: Sequence[ca.SX]) -> ca.SX:
    """Evaluate a program from vectors to one vector, as a dense column; ValueError for an unknown operation."""
    (result,) = CasadiTranslation().run(program, [Entries(one, (one.numel(),)) for one in symbols])
    return ca.densify(ca.SX(result))


_SAME_NAME = (
    *("sign", "floor", "ceil", "sqrt", "exp", "expm1", "log", "log1p", "erf", "atan2"),
    *("sin", "cos", "tan", "asin", "acos", "atan", "sinh", "cosh", "tanh", "asinh", "acosh", "atanh"),
)
OPERATIONS: dict[str, Callable] = {
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


class CasadiTranslation(Translation[Column]):
    """Columns are expressions, or numbers, n × 1."""

    language: ClassVar[str] = "CasADi"
    operations: ClassVar[dict[str, Callable]] = OPERATIONS

    def known(self, array):
        return ca.DM(np.asarray(array, float).reshape(-1, 1))

    def join(self, columns):
        return ca.vertcat(*columns)

    def take(self, column, places):
        return column[list(places), 0]

    def entrywise(self, name, columns, shape, exponent=0):
        return columns[0] ** exponent if name == "integer_pow" else OPERATIONS[name](*columns)

    def fold(self, name, rows):
        return reduce(OPERATIONS[name], rows)

    def matrix_product(self, left, right, sizes):
        m, k, n = sizes
        # CasADi is column-major and columns are row-major, hence the transposes.
        a, b = ca.reshape(left, k, m).T, ca.reshape(right, n, k).T
        a = ca.sparsify(a) if isinstance(a, ca.DM) else a
        return ca.vec(ca.mtimes(a, b).T)
