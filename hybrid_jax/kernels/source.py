"""Generate a field's C++: programs of one sample, vectorised over samples, for cpp/rollout.h."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, ClassVar

import jax
import numpy as np
from jax.extend.core import ClosedJaxpr, jaxpr_as_fun

from hybrid_jax.codegen import loops, nodes
from hybrid_jax.codegen.nodes import Address, Assign, Call, Element, Entry, Expression, Operation, Statement, arranged
from hybrid_jax.codegen.operations import LOGICAL, CTranslation, column, is_zero
from hybrid_jax.codegen.printer import MATH, CPrinter
from hybrid_jax.codegen.tables import Tables
from hybrid_jax.codegen.translation import Entries
from hybrid_jax.kernels.trace import Products, Shape, Split, outputs_of, split, traced, with_factors

LONGEST = 4000  # statements of a function: GCC takes long for more, and a program of XLA does as well
CHEAP = {"add", "sub", "mul", "neg", "max", "min", "select_n", "convert_element_type", *LOGICAL}
INLINED = 12  # operations of an entry that are done again wherever it is needed, at most
LARGEST = 8192  # numbers in a function's arrays per sample


class SampleTranslation(CTranslation):
    """Translates for one of many samples: weights and constants are shared, so their matrices are not copied."""

    language: ClassVar[str] = "kernels"

    def scan(self, equation, inputs):
        raise self._refusal(equation)

    def _loops(self, a, b):
        (m, k), n = a.shape, b.shape[1]
        if m == 1 and n > 1:
            return self._loops(b.T, a.T).T
        if n > 1:
            return super()._loops(a, b)
        place = loops.indexed(self.tables, a.ravel(), a.shape)
        if not isinstance(place, Element):
            place = loops.indexed(self.tables, self._gathered(a.ravel()), a.shape)
            assert isinstance(place, Element)  # contiguous
        vector = loops.address(self.tables, self._gathered(b.ravel(), b.shape))
        given = (Address(place.name, place.corner), *place.steps, vector)
        return self._filled(m, lambda out: Call(f"dense<{m}, {k}>", (*given, Address(out)))).reshape(m, 1)

    def body(self, results, outs, begins):
        """Inline cheap values in loops over entries instead of storing arrays."""
        filled = zip(outs, results, begins, strict=False)
        end = [one for out, result, begin in filled for one in loops.stores(out, result, begin)]
        known: dict[tuple[int, ...], dict[Any, Expression]] = {}  # shape → entry of an array → what it is
        steps = [
            replace(step, code=tuple(_inlined(one, known, step.makes) for one in step.code)) for step in self.steps
        ]
        end = _merged([_inlined(one, known) for one in end])
        return arranged(steps, nodes.names(tuple(end)), end)


def _inlined(statement: Statement, known: dict[tuple[int, ...], dict[Any, Expression]], makes: str = "") -> Statement:
    """Inline known entries in a loop; also record its result if that is cheap."""
    shape, inner = [], statement
    while isinstance(inner, nodes.Loop) and len(inner.body) == 1 and not inner.start:
        shape, inner = [*shape, inner.stop], inner.body[0]
    if not shape or not isinstance(inner, Assign):
        return statement
    entries = known.setdefault(tuple(shape), {})

    def written(value: Expression) -> Expression:
        if isinstance(value, Operation):
            return replace(value, operands=tuple(map(written, value.operands)))
        return entries.get(value, value) if isinstance(value, Element) else value

    inner = replace(inner, value=written(inner.value))
    operations = [one.name for one in nodes.walk(inner.value) if isinstance(one, Operation)]
    if inner.target.name == makes and len(operations) <= INLINED and CHEAP.issuperset(operations):
        entries[inner.target] = inner.value
    return nodes.nested(shape, inner)


def _merged(statements: Sequence[Statement]) -> list[Statement]:
    """Fuse loops of equal length."""
    bodies: dict[int, list[Statement]] = {}
    for one in statements:
        if isinstance(one, nodes.Loop):
            bodies.setdefault(one.stop, []).extend(one.body)
    single = [one for one in statements if not isinstance(one, nodes.Loop)]
    return [*single, *(nodes.Loop(0, stop, tuple(body)) for stop, body in bodies.items())]


class SamplePrinter(CPrinter):
    """Prints numbers of each sample as vectors and shared numbers as scalars; see cpp/samples.h."""

    def number(self, value: float) -> str:
        return super().number(value).replace("(real)", "")

    def _operation(self, name: str, operands: Sequence[nodes.Expression]) -> str:
        if name == "select_n":
            which, otherwise, chosen = map(self.expression, operands)
            return f"choose({which}, {chosen}, {otherwise})"
        if name == "convert_element_type":
            return f"number({self.expression(operands[0])})"
        return super()._operation(name, operands)

    def _operand(self, node: nodes.Expression) -> str:
        own = isinstance(node, Operation) and node.name in ("select_n", "convert_element_type")
        return self.expression(node) if own else super()._operand(node)

    def statement(self, node: nodes.Statement) -> str:
        match node:
            case nodes.Variable(name, value, _, True):
                return f"const auto {name} = {self.expression(value)};"
            case nodes.Variable(name, value):
                return f"auto {name} = wide({self.expression(value)});"
            case nodes.Array(name, size, logical):
                return f"HELD {'logical' if logical else 'real'} {name}[{size}];"
            case nodes.Assign(target, value):
                return f"{self.expression(target)} = wide({self.expression(value)});"
        return super().statement(node)


GIVEN = "const float *__restrict w, const Vec *__restrict x, const Vec *__restrict u, "
BACK = {
    "slope_back": "const Vec *__restrict n, const Vec *__restrict d_slope, Vec *dx, Vec *du, Vec *dn, Sums s, Vec *f",
    "read_back": "const Vec *d_read, Vec *dx, Vec *du, Sums s",
}
Outputs = list[tuple[str, int]]  # arrays, and where in them the results begin


class Source:
    """Functions of a field's weights and of one sample: x, u, and n; see cpp/rollout.h."""

    def __init__(self, forward: Split, of_sample: Sequence[Shape], training: bool):
        self.tables = Tables(double=False)
        self.bodies: list[tuple[nodes.Statement, ...]] = []
        self.functions: list[str] = []
        self.factors, self.places = 1, _places(forward.shapes)
        self.back = self._add_backward(forward, of_sample) if training else None
        for i, (name, given) in enumerate((("slope", "const Vec *__restrict n, Vec *out"), ("read", "Vec *out"))):
            program = outputs_of(forward.program, [i])
            self._add(name, given, program, self.places, ("x", "u", "n"), [("out", 0)])

    def _add_backward(self, forward: Split, of_sample: Sequence[Shape]) -> Split:
        """Add `slope_back`, `products` and `read_back`; return their weights as a function of the weights."""
        count, (slope, read, *_) = len(forward.shapes), forward.program.out_avals
        parts = [jaxpr_as_fun(outputs_of(forward.program, [i])) for i in range(2)]

        def pulled_back(*arrays):
            *arrays, d_slope, d_read = arrays
            ways = (jax.vjp(part, *arrays)[1]([slope]) for part, slope in zip(parts, (d_slope, d_read), strict=True))
            return [slope for way in ways for slope in way]

        back = split(traced(pulled_back, *forward.shapes, *of_sample, slope, read), count)
        whole, products = with_factors(outputs_of(back.program, range(count + 3)), count)
        reading = outputs_of(back.program, range(count + 3, 2 * count + 5))
        ways: Outputs = [("dx", 0), ("du", 0), ("dn", 0)]
        sums: Outputs = [("s", place) for place in self.places]
        kept = [one for i, one in enumerate(sums) if i not in products]
        inputs, places = ("x", "u", "n", "d_slope", "d_read"), _places(back.shapes)
        self._add("slope_back", BACK["slope_back"], whole, places, inputs, [*kept, *ways, *self._factors(products)])
        self._add("read_back", BACK["read_back"], reading, places, inputs, [*sums, *ways[:2]])
        return back

    def _factors(self, products: Products) -> Outputs:
        """Return where the factors of products begin; `products` multiplies and sums them."""
        outputs, at, calls = [], 0, []
        for i, pairs in products.items():
            for rows, columns in pairs:
                outputs += [("f", at), ("f", at + rows)]
                where = f"sums + {self.places[i]}, factors + {at}, F, factors + {at + rows}, F, slots"
                calls.append(f"    add_products<{rows}, {columns}>({where});")
                at += rows + columns
        self.factors = at | 1  # an even number of vectors may put all slots into the same lines of the cache
        head = "void products(Vec *sums, const Vec *factors, int64_t slots) {"
        self.functions.append("\n".join([head, *calls, "}\n"]))
        return outputs

    def _add(self, name: str, parameters: str, program: ClosedJaxpr, weights, inputs, outputs: Outputs) -> None:
        """Add a function of inputs and weights, which begin at these places of `w`, that fills the outputs."""
        starts = [*(("w", place) for place in weights), *((name, 0) for name in inputs)]
        arguments = [
            Entries(column(Entry(array, first + k) for k in range(one.size)), one.shape)
            for (array, first), one in zip(starts, program.in_avals, strict=True)
        ]
        translation = SampleTranslation(self.tables)
        pairs = zip(outputs, translation.run(program, arguments), strict=True)
        written = [(*out, one) for out, one in pairs if len(one) and not (out[0] == "s" and is_zero(one))]
        outs, begins, results = zip(*written, strict=True) if written else ((), (), ())
        body = translation.body(results, outs, begins)
        held = sum(one.size for one in nodes.walk(body) if isinstance(one, nodes.Array))
        if len(body) > LONGEST or held > LARGEST:
            raise ValueError(f"its evaluation takes {len(body)} statements and {held} numbers, too many for kernels")
        self.bodies.append(body)
        text = SamplePrinter(double=False).body(body)
        self.functions.append(f"void {name}({GIVEN}{parameters}) {{\n{text}\n}}\n")

    def text(self, constants: dict[str, int]) -> str:
        printer, read = SamplePrinter(double=False), nodes.names(tuple(self.bodies))
        head = [f"#define TRAINING {int(self.back is not None)}", '#include "samples.h"', "namespace {"]
        head += [f"constexpr int64_t {name} = {value};" for name, value in (constants | {"F": self.factors}).items()]
        tables = [printer.table(name, numbers) for name, numbers in self.tables.numbers.items() if name in read]
        lines = [*head, *(table.replace("real", "float", 1) for table in tables), *self.functions]
        return "\n".join([*lines, "}  // namespace", '#include "rollout.h"', ""])

    def needs_math(self) -> bool:
        """Whether functions of glibc's vector library are called."""
        every = (one for one in nodes.walk(tuple(self.bodies)) if isinstance(one, Operation))
        return any(one.name in MATH and one.name not in ("floor", "ceil", "sqrt", "abs", "rem") for one in every)


def _places(shapes: Sequence[Shape]) -> list[int]:
    """Return where each array begins in the concatenation of all."""
    return np.cumsum([0, *(one.size for one in shapes)])[:-1].tolist()
