"""Generate a field's C++: programs of one sample, vectorised over samples, for cpp/rollout.h."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import jax
from jax.extend.core import ClosedJaxpr, jaxpr_as_fun

from hybrid_jax.codegen import loops, nodes
from hybrid_jax.codegen.loops import Tables
from hybrid_jax.codegen.nodes import Address, Entry, Expression, Loop, Operation, Statement
from hybrid_jax.codegen.operations import CTranslation, entries, is_zero
from hybrid_jax.codegen.printer import LOGIC, OPERATIONS, CPrinter
from hybrid_jax.kernels.library import width
from hybrid_jax.kernels.trace import Shape, Split, outputs_of, split, traced, with_factors

LONGEST = 4000  # statements of a function; for more, GCC takes long, and XLA is as fast
CHEAP = {"add", "sub", "mul", "neg", "max", "min", "not", "select_n", "convert_element_type", *LOGIC}
INLINED = 12  # most operations that are repeated wherever their result is needed
LARGEST = 8192  # most numbers in a function's arrays per sample


@dataclass
class SampleTranslation(CTranslation):
    """Translates a program for one of many samples, which share weights and constants without copies."""

    language: ClassVar[str] = "kernels"
    _cheap: dict[Any, Expression] = field(default_factory=dict)  # shape and entry of an array → its value

    def scan(self, equation, inputs):
        raise self._unsupported(equation)

    def _mapped(self, value, shape):
        """Store a value in an array, but compute cheap ones again in loops over entries instead of reading them."""
        value = self._inlined(value, shape)
        made = super()._mapped(value, shape)
        operations = [one.name for one in nodes.walk(value) if isinstance(one, Operation)]
        if len(operations) <= INLINED and CHEAP.issuperset(operations):
            self._cheap[shape, loops.indexed(self.tables, made)] = value
        return made

    def _inlined(self, value: Expression, shape: tuple[int, ...]) -> Expression:
        if isinstance(value, Operation):
            return replace(value, operands=tuple(self._inlined(one, shape) for one in value.operands))
        return self._cheap.get((shape, value), value)

    def _end(self, results, outs, begins):
        """Fuse loops of equal length."""
        bodies, single = dict[int, list[Statement]](), list[Statement]()
        for one in super()._end(results, outs, begins):
            if isinstance(one, Loop):
                shorter = (replace(each, value=self._inlined(each.value, (one.stop,))) for each in one.body)  # type: ignore
                bodies.setdefault(one.stop, []).extend(shorter)
            else:
                single.append(one)
        return [*single, *(nodes.nested((stop,), *body) for stop, body in bodies.items())]


class SamplePrinter(CPrinter):
    """Prints numbers of each sample as vectors and shared numbers as scalars; see cpp/samples.h."""

    operations: ClassVar[dict[str, str]] = OPERATIONS | {
        "select_n": "choose({0}, {2}, {1})",
        "convert_element_type": "wide({0})",
        "sign": "wide({0} > 0) - wide({0} < 0)",
    }

    def number(self, value: float) -> str:
        return super().number(value).replace("(real)", "")

    def statement(self, node: nodes.Statement) -> str:
        match node:
            case nodes.Variable(name, value):
                return f"const auto {name} = {self.expression(value)};"
            case nodes.Array(name, size):
                return f"HELD real {name}[{size}];"
            case nodes.Assign(target, value):  # sums over samples begin at zero
                sign = "+=" if target.name == "s" else "="
                return f"{self.expression(target)} {sign} wide({self.expression(value)});"
            case nodes.Call("product", (*arguments, m, k, n)):
                return f"product<{m}, {k}, {n}>({', '.join(map(self.expression, arguments))});"
        return super().statement(node)


GIVEN = "const float *__restrict w, const Vec *__restrict x, const Vec *__restrict u, "
SLOPE, READ = "const Normal n, Vec *out", "Vec *out"
SLOPE_BACK = "const Normal n, const Vec *__restrict d_slope, Vec *dx, Vec *dn, Vec *s, Vec *f"
READ_BACK = "const Vec *d_read, Vec *dx, Vec *s"
Outputs = list[tuple[str, int]]  # array, and where a result begins in it


class Source:
    """Functions of a field's weights and of one sample x, u, n; see cpp/rollout.h. `back` computes its own weights."""

    def __init__(self, forward: Split, of_sample: Sequence[Shape], training: bool):
        self.tables, self.printer = Tables(double=False), SamplePrinter(double=False)
        self.constants = {"F": 1, "BACK": 0}
        self.functions, self.code = list[str](), tuple[Any, ...]()
        self.back = self._add_backward(forward, of_sample) if training else None
        for i, (name, given) in enumerate((("slope", SLOPE), ("read", READ))):
            program = outputs_of(forward.program, [i])
            self._add(name, given, program, forward.places(), ("x", "u", "n"), [("out", 0)])

    def _add_backward(self, forward: Split, of_sample: Sequence[Shape]) -> Split:
        """Add `slope_back`, `products` and `read_back`."""
        count, (slope, read, *_) = len(forward.shapes), forward.program.out_avals
        parts = [jaxpr_as_fun(outputs_of(forward.program, [i])) for i in range(2)]

        def pulled_back(*arrays):
            *arrays, d_slope, d_read = arrays
            ways = (jax.vjp(part, *arrays)[1]([slope]) for part, slope in zip(parts, (d_slope, d_read), strict=True))
            return [slope for *of, dx, _, dn in ways for slope in (*of, dx, dn)]  # inputs are data

        back = split(traced(pulled_back, *forward.shapes, *of_sample, slope, read), count)
        whole, products = with_factors(outputs_of(back.program, range(count + 2)), count)
        reading = outputs_of(back.program, range(count + 2, 2 * count + 3))
        sums: Outputs = [("s", place) for place in forward.places()]
        outputs, at, calls = [*(one for i, one in enumerate(sums) if i not in products), ("dx", 0), ("dn", 0)], 0, []
        for i, pairs in products.items():
            for rows, columns in pairs:
                outputs += [("f", at), ("f", at + rows)]
                where = f"sums + {sums[i][1]}, factors + {at}, F, factors + {at + rows}, F, slots"
                calls.append(f"    add_products<{rows}, {columns}>({where});")
                at += rows + columns
        self.constants["F"] = at | 1  # with an even number of vectors, all slots could share lines of the cache
        inputs = ("x", "u", "n", "d_slope", "d_read")
        self._add("slope_back", SLOPE_BACK, whole, back.places(), inputs, outputs)
        body = self._add("read_back", READ_BACK, reading, back.places(), inputs, [*sums, ("dx", 0)])
        used = (one for one in nodes.walk(body) if isinstance(one, Entry) and one.name == "d_read")
        ends = (read.size if one.steps or isinstance(one, Address) else (one.index or 0) + 1 for one in used)
        self.constants["BACK"] = max(ends, default=0)
        head = "void products(Vec *sums, const Vec *factors, int64_t slots) {"
        self.functions.append("\n".join([head, *calls, "}\n"]))
        return back

    def _add(self, name: str, parameters: str, program: ClosedJaxpr, weights, inputs, outputs: Outputs) -> tuple:
        """Add a function that fills outputs from inputs and weights, which begin at these places of `w`."""
        starts = [*(("w", place) for place in weights), *((name, 0) for name in inputs)]
        pairs = zip(starts, program.in_avals, strict=True)
        arguments = [entries(array, one.shape, first) for (array, first), one in pairs]
        translation = SampleTranslation(self.tables)
        pairs = zip(outputs, translation.run(program, arguments), strict=True)
        written = [(*out, one) for out, one in pairs if one.size and not (out[0] == "s" and is_zero(one))]
        outs, begins, results = zip(*written, strict=True) if written else ((), (), ())
        body = translation.body(results, outs, begins)
        held = sum(one.size for one in nodes.walk(body) if isinstance(one, nodes.Array))
        if len(body) > LONGEST or held > LARGEST:
            raise ValueError(f"its evaluation takes {len(body)} statements and {held} numbers, too many for kernels")
        self.code = *self.code, body
        self.functions.append(f"void {name}({GIVEN}{parameters}) {{\n{self.printer.body(body)}\n}}\n")
        return body

    def text(self, constants: dict[str, int]) -> str:
        head = [f"#define TRAINING {int(self.back is not None)}", f"#define V {width()}"]
        head += ['#include "samples.h"', "namespace {"]
        head += [f"constexpr int64_t {name} = {value};" for name, value in (constants | self.constants).items()]
        tables = [one.replace("real", "float", 1) for one in self.printer.tables(self.tables, self.code)]
        return "\n".join([*head, *tables, *self.functions, "}  // namespace", '#include "rollout.h"', ""])
