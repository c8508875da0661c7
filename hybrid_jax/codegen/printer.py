"""Print nodes as C99."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from hybrid_jax.codegen import nodes
from hybrid_jax.codegen.loops import Tables
from hybrid_jax.codegen.nodes import Address, Entry, Operation

LOGIC = {"and": "&&", "or": "||", "lt": "<", "le": "<=", "gt": ">", "ge": ">=", "eq": "==", "ne": "!="}
_INFIX = {"add": "+", "sub": "-", "mul": "*", "div": "/", **LOGIC}
_MATH = (
    *("floor", "ceil", "sqrt", "exp", "expm1", "log", "log1p", "erf", "erfc", "exp2", "cbrt"),
    *("sin", "cos", "tan", "asin", "acos", "atan", "sinh", "cosh", "tanh", "asinh", "acosh", "atanh"),
)
# Operation of JAX → C of its operands {0}, …, where {f} is the suffix of single precision in math.h.
OPERATIONS = {
    **{name: f"{{0}} {sign} {{1}}" for name, sign in _INFIX.items()},
    **{name: f"{name}{{f}}({{0}})" for name in _MATH},
    **{"abs": "fabs{f}({0})", "atan2": "atan2{f}({0}, {1})", "pow": "pow{f}({0}, {1})", "rem": "fmod{f}({0}, {1})"},
    **{"max": "larger({0}, {1})", "min": "smaller({0}, {1})"},  # of HELPERS
    **{"neg": "-{0}", "not": "!{0}", "convert_element_type": "(real){0}", "select_n": "{0} ? {2} : {1}"},
    **{"square": "{0} * {0}", "rsqrt": "1 / sqrt{f}({0})", "logistic": "1 / (1 + exp{f}(-{0}))"},
    "sign": "(real)(({0} > 0) - ({0} < 0))",
}
HELPERS = {
    "larger": """\
/* NaN, if one is NaN. */
static real larger(real a, real b) { return a > b || a != a ? a : b; }
""",
    "smaller": """\
/* NaN, if one is NaN. */
static real smaller(real a, real b) { return a < b || a != a ? a : b; }
""",
    "product": """\
/* out = A B, of m x k and k x n, with A[i, l] at a[i * row + l * step]; four rows at a time, so that sums need not
   wait for each other. */
static void product(const real *restrict a, int row, int step, const real *restrict b, real *restrict out, int m,
                    int k, int n) {
    for (int j = 0; j < n; ++j) {
        int i = 0;
        for (; i + 4 <= m; i += 4) {
            const real *at = a + i * row;
            real p = 0, q = 0, r = 0, s = 0;
            for (int l = 0; l < k; ++l, at += step) {
                const real v = b[l * n + j];
                p += at[0] * v;
                q += at[row] * v;
                r += at[2 * row] * v;
                s += at[3 * row] * v;
            }
            out[i * n + j] = p;
            out[(i + 1) * n + j] = q;
            out[(i + 2) * n + j] = r;
            out[(i + 3) * n + j] = s;
        }
        for (; i < m; ++i) {
            real p = 0;
            for (int l = 0; l < k; ++l) { p += a[i * row + l * step] * b[l * n + j]; }
            out[i * n + j] = p;
        }
    }
}
""",
}


@dataclass(frozen=True)
class CPrinter:
    """Prints nodes in double or single precision."""

    double: bool
    operations: ClassVar[dict[str, str]] = OPERATIONS

    def number(self, value: float) -> str:
        """Print a number, in brackets if negative."""
        if not np.isfinite(value):
            return "((real)NAN)" if value != value else f"((real){'-' if value < 0 else ''}INFINITY)"
        digits = repr(value) if self.double else f"{np.float32(value):.9g}"
        digits = digits if any(mark in digits for mark in ".en") else f"{digits}.0"
        digits += "" if self.double else "f"
        return f"({digits})" if value < 0 else digits

    def expression(self, node: Any) -> str:
        """Print an expression without brackets."""
        match node:
            case bool() | int():
                return str(int(node))
            case float():
                return self.number(node)
            case Address(name, index, steps):
                return f"{name} + {_place(index or 0, steps)}" if index or any(steps) else name
            case Entry(name, index, steps):
                return name if index is None else f"{name}[{_place(index, steps)}]"
            case Operation(name, operands):
                return self.operations[name].format(*map(self._operand, operands), f="" if self.double else "f")
        raise TypeError(f"{type(node).__name__} is not an expression")

    def _operand(self, node: nodes.Expression) -> str:
        text = self.expression(node)
        return f"({text})" if isinstance(node, Operation) and not self.operations[node.name][0].isalpha() else text

    def statement(self, node: nodes.Statement) -> str:
        match node:
            case nodes.Variable(name, value):
                kind = "int" if isinstance(value, Operation) and value.name in (*LOGIC, "not") else "real"
                return f"const {kind} {name} = {self.expression(value)};"
            case nodes.Array(name, size):
                return f"real {name}[{size}];"
            case nodes.Assign(target, value):
                return f"{self.expression(target)} = {self.expression(value)};"
            case nodes.Call(function, arguments):
                return f"{function}({', '.join(map(self.expression, arguments))});"
            case nodes.Loop(i, stop, body, start):
                inside = self.statement(body[0]) if len(body) == 1 else f"{{\n{self.body(body)}\n}}"
                return f"for (int {i} = {start}; {i} < {stop}; ++{i}) {inside}"

    def body(self, statements: Iterable[nodes.Statement]) -> str:
        return "\n".join(f"    {line}" for one in statements for line in self.statement(one).splitlines())

    def table(self, name: str, numbers: np.ndarray) -> str:
        rows = (", ".join(self.number(float(one)) for one in numbers[i : i + 8]) for i in range(0, len(numbers), 8))
        lines = ",\n    ".join(rows)
        return f"static const real {name}[{len(numbers)}] = {{\n    {lines}}};"

    def tables(self, tables: Tables, code: tuple) -> list[str]:
        read = nodes.names(code)
        return [self.table(name, numbers) for name, numbers in tables.numbers.items() if name in read]

    def function(self, one: nodes.Function) -> str:
        given = [*(f"const real *{each.name}" for each in one.inputs), *(f"real *{each.name}" for each in one.outputs)]
        read = nodes.names(one.body)
        unused = "".join(f"    (void){array.name};\n" for array in one.inputs if array.name not in read)
        return f"static void {one.name}({', '.join(given)}) {{\n{unused}{self.body(one.body)}\n}}\n"

    def file(self, tables: Tables, names: Iterable[str]) -> str:
        """Print the functions with these names, and the tables, helpers and functions that they use."""
        used, printed = set(names), list[nodes.Function]()
        for one in reversed(tables.functions.values()):
            if one.name in used:
                printed.insert(0, one)
                inside = list(nodes.walk(one.body))
                used |= {each.function for each in inside if isinstance(each, nodes.Call)}
                used |= {OPERATIONS[each.name].partition("(")[0] for each in inside if isinstance(each, Operation)}
        helpers = [text for name, text in HELPERS.items() if name in used]
        numbers = self.tables(tables, tuple(one.body for one in printed))
        return "\n".join([*numbers, "", *helpers, *map(self.function, printed)])


def _place(corner: int, steps: Sequence[int]) -> str:
    terms = [f"i{axis}" if step == 1 else f"{step} * i{axis}" for axis, step in enumerate(steps) if step]
    return " + ".join([*([str(corner)] if corner or not terms else []), *terms])
