"""Print nodes as C99."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from hybrid_jax.codegen import nodes
from hybrid_jax.codegen.helpers import HELPERS
from hybrid_jax.codegen.nodes import Address, Element, Entry, Operation
from hybrid_jax.codegen.tables import Tables

_SAME_NAME = (
    *("floor", "ceil", "sqrt", "exp", "expm1", "log", "log1p", "erf", "erfc", "exp2", "cbrt", "atan2", "pow"),
    *("sin", "cos", "tan", "asin", "acos", "atan", "sinh", "cosh", "tanh", "asinh", "acosh", "atanh"),
)
MATH: dict[str, str] = {**{name: name for name in _SAME_NAME}, "abs": "fabs", "rem": "fmod"}  # of math.h
CALLED = {"max": "larger", "min": "smaller"}  # of HELPERS
PREFIX = {"neg": "-", "not": "!", "convert_element_type": "(real)"}
INFIX = {
    **{"add": "+", "sub": "-", "mul": "*", "div": "/", "and": "&&", "or": "||"},
    **{"lt": "<", "le": "<=", "gt": ">", "ge": ">=", "eq": "==", "ne": "!="},
}
OPERATIONS = (*MATH, *CALLED, *PREFIX, *INFIX, "select_n")


@dataclass(frozen=True)
class CPrinter:
    """Prints nodes in double or single precision."""

    double: bool

    def number(self, value: float) -> str:
        """Print a number, in brackets if negative."""
        if not np.isfinite(value):
            return "((real)NAN)" if value != value else f"((real){'-' if value < 0 else ''}INFINITY)"
        digits = repr(value) if self.double else f"{np.float32(value):.9g}"
        digits = digits if any(mark in digits for mark in ".en") else f"{digits}.0"
        digits += "" if self.double else "f"
        return f"({digits})" if value < 0 else digits

    def expression(self, node: Any) -> str:
        """Print an expression without brackets around it."""
        match node:
            case bool() | int():
                return str(int(node))
            case float():
                return self.number(node)
            case Entry(name, index):
                return name if index is None else f"{name}[{index}]"
            case Element(name, corner, steps):
                return f"{name}[{_place(corner, steps)}]"
            case Address(name, corner, steps):
                return f"{name} + {_place(corner, steps)}" if corner or any(steps) else name
            case Operation(name, operands):
                return self._operation(name, operands)
        raise TypeError(f"{type(node).__name__} is not an expression")

    def _operation(self, name: str, operands: Sequence[nodes.Expression]) -> str:
        if name in MATH or name in CALLED:
            function = CALLED[name] if name in CALLED else MATH[name] + ("" if self.double else "f")
            return f"{function}({self._list(operands)})"
        first, *others = map(self._operand, operands)
        if name in PREFIX:
            return f"{PREFIX[name]}{first}"
        return f"{first} ? {others[1]} : {others[0]}" if name == "select_n" else f"{first} {INFIX[name]} {others[0]}"

    def _operand(self, node: nodes.Expression) -> str:
        text = self.expression(node)
        closed = not isinstance(node, Operation) or node.name in MATH or node.name in CALLED
        return text if closed else f"({text})"

    def _list(self, expressions: Iterable[nodes.Expression]) -> str:
        return ", ".join(map(self.expression, expressions))

    def statement(self, node: nodes.Statement) -> str:
        """Print a statement on one line."""
        match node:
            case nodes.Variable(name, value, logical, constant):
                return f"{'const ' * constant}{_kind(logical)} {name} = {self.expression(value)};"
            case nodes.Array(name, size, logical):
                return f"{_kind(logical)} {name}[{size}];"
            case nodes.Assign(target, value):
                return f"{self.expression(target)} = {self.expression(value)};"
            case nodes.Call(function, arguments):
                return f"{function}({self._list(arguments)});"
            case nodes.Loop(counter, stop, body, start):
                i, inside = f"i{counter}", " ".join(map(self.statement, body))
                alone = len(body) == 1 and isinstance(body[0], nodes.Loop)
                return f"for (int {i} = {start}; {i} < {stop}; ++{i}) " + (inside if alone else f"{{ {inside} }}")

    def body(self, statements: Iterable[nodes.Statement]) -> str:
        return "\n".join(f"    {self.statement(one)}" for one in statements)

    def function(self, node: nodes.Function) -> str:
        parameters = ", ".join(map(_parameter, node.parameters))
        return f"static void {node.name}({parameters}) {{\n{self.body(node.body)}\n}}\n"

    def table(self, name: str, numbers: np.ndarray) -> str:
        rows = (", ".join(self.number(float(one)) for one in numbers[i : i + 8]) for i in range(0, len(numbers), 8))
        lines = ",\n    ".join(rows)
        return f"static const real {name}[{len(numbers)}] = {{\n    {lines}}};"

    def shared(self, tables: Tables, *bodies: Sequence[nodes.Statement]) -> dict[str, str]:
        """Print the tables and functions that bodies use, as parts of a template."""
        code = (*tables.functions, *bodies)
        read, every = nodes.names(code), list(nodes.walk(code))
        called = {one.function for one in every if isinstance(one, nodes.Call)}
        called |= {CALLED.get(one.name) for one in every if isinstance(one, Operation)}
        helpers = [text for name, text in HELPERS.items() if name in called]
        return {
            "tables": "\n".join(self.table(name, numbers) for name, numbers in tables.numbers.items() if name in read),
            "helpers": "\n".join([*helpers, *map(self.function, tables.functions)]),
            "type": "double" if self.double else "float",
        }


def _kind(logical: bool) -> str:
    return "int" if logical else "real"


def _place(corner: int, steps: Sequence[int]) -> str:
    terms = [f"i{axis}" if step == 1 else f"{step} * i{axis}" for axis, step in enumerate(steps) if step]
    return " + ".join([*([str(corner)] if corner or not terms else []), *terms])


def _parameter(one: nodes.Parameter) -> str:
    kind = _kind(one.logical)
    if not one.array:
        return f"{kind} {one.name}"
    return f"{kind} *{one.name}" if one.written else f"const {kind} *{one.name}"
