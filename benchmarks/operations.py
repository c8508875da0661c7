"""How many floating-point operations a program asks for, counted in its jaxpr."""

import math
from collections import Counter
from collections.abc import Callable, Iterator
from typing import Any

import jax
from jax.extend.core import ClosedJaxpr, Jaxpr
from jaxtyping import PyTree

ARITHMETIC = {
    "add", "add_any", "cos", "div", "exp", "integer_pow", "log", "max", "min", "mul", "neg", "pow", "rsqrt", "sin",
    "sqrt", "square", "sub", "tanh",
}  # fmt: skip
SUMS = {"reduce_sum", "reduce_max", "reduce_min"}


def count_operations(function: Callable[..., PyTree], *arguments: PyTree) -> Counter[str]:
    """Operations of one call: `matrix`, two for each multiply-add of a matrix product, and `elementwise`, one a number.

    A loop counts as often as it runs; a `while` loop, whose length the program does not state, counts once. What the
    compiler leaves out or repeats is not seen, so this is an estimate.
    """
    return _count(jax.make_jaxpr(function)(*arguments).jaxpr)


def _count(jaxpr: Jaxpr) -> Counter[str]:
    total: Counter[str] = Counter()
    for equation in jaxpr.eqns:
        total += _count_equation(equation)
        times = equation.params.get("length", 1) if equation.primitive.name == "scan" else 1
        for inner in _inner(equation.params):
            total += Counter({kind: times * number for kind, number in _count(inner).items()})
    return total


def _count_equation(equation: Any) -> Counter[str]:
    name = equation.primitive.name
    size = sum(result.aval.size for result in equation.outvars if name in ARITHMETIC or name == "dot_general")
    if name == "dot_general":
        (contracted, _), _ = equation.params["dimension_numbers"]
        shape = equation.invars[0].aval.shape
        return Counter(matrix=2 * size * math.prod(shape[axis] for axis in contracted))
    return Counter(elementwise=equation.invars[0].aval.size if name in SUMS else size)


def _inner(parameters: dict[str, Any]) -> Iterator[Jaxpr]:
    """The programs inside an equation: a loop's body, a called function."""
    for value in parameters.values():
        for part in value if isinstance(value, tuple) else (value,):
            if isinstance(part, ClosedJaxpr):
                yield part.jaxpr
            elif isinstance(part, Jaxpr):
                yield part
