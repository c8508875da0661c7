"""Translate JAX programs into CasADi expressions."""

from collections.abc import Callable, Sequence
from operator import add, eq, ge, gt, le, lt, mul, ne, neg, pow, sub, truediv
from typing import ClassVar

import casadi as ca
from jax.extend.core import ClosedJaxpr

from hybrid_jax.codegen.translation import Translation, array_of


def evaluate(program: ClosedJaxpr, symbols: Sequence[ca.SX]) -> ca.SX:
    """Evaluate a program from vectors to one vector, as a dense column; ValueError for an unknown operation."""
    (result,) = CasadiTranslation().run(program, [array_of(ca.vertsplit(one)) for one in symbols])
    return ca.densify(ca.SX(ca.vertcat(*result)))


_SAME_NAME = (
    *("sign", "floor", "ceil", "sqrt", "exp", "expm1", "log", "log1p", "erf", "atan2"),
    *("sin", "cos", "tan", "asin", "acos", "atan", "sinh", "cosh", "tanh", "asinh", "acosh", "atanh"),
)
OPERATIONS: dict[str, Callable] = {
    **{name: getattr(ca, name) for name in _SAME_NAME},
    **{operation.__name__: operation for operation in (add, sub, mul, pow, neg, lt, le, gt, ge, eq, ne)},
    "convert_element_type": lambda a: a,
    "div": truediv,
    "rem": ca.fmod,
    "max": ca.fmax,
    "min": ca.fmin,
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


class CasadiTranslation(Translation):
    """Translates into CasADi, with scalar expressions as entries."""

    language: ClassVar[str] = "CasADi"
    operations: ClassVar[dict[str, Callable]] = OPERATIONS

    def scalar(self, name, *operands):
        return OPERATIONS[name](*map(ca.SX, operands))

    def matrix_product(self, a, b):
        left, right = (ca.horzcat(*(ca.vertcat(*column) for column in one.T)) for one in (a, b))
        return array_of(ca.vertsplit(ca.vec(ca.mtimes(left, right).T))).reshape(len(a), b.shape[1])
