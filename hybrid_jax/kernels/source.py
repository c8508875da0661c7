"""The C++ of a field: programs of one sample, for a vector of samples at a time, before cpp/rollout.h."""

from collections.abc import Sequence
from typing import ClassVar

import jax
import numpy as np

from hybrid_jax.codegen import loops, nodes
from hybrid_jax.codegen.nodes import Address, Call, Element, Entry, Operation
from hybrid_jax.codegen.operations import CTranslation, column
from hybrid_jax.codegen.printer import MATH, CPrinter
from hybrid_jax.codegen.tables import Tables
from hybrid_jax.codegen.translation import Entries, Value
from hybrid_jax.kernels.trace import Products, Program, Shape, Split, split, traced, with_factors

LONGEST = 4000  # statements of a function: GCC takes long for more, and a program of XLA does as well
LARGEST = 8192  # numbers of arrays that a function holds for each sample


class SampleTranslation(CTranslation):
    """Of one sample of many: weights and constants are the same for all, and a matrix of them need not be copied."""

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
        sizes = (Address(place.name, place.corner), *place.steps, vector)
        return self._filled(m, lambda out: Call("dense", (*sizes, Address(out), m, k))).reshape(m, 1)

    def columns(self, program: Program, arguments: Sequence[Value]) -> list[np.ndarray]:
        """The outputs of a program."""
        values: dict[int, Value] = {number: np.asarray(value) for number, value in program.constants.items()}
        values.update(zip(program.inputs, arguments, strict=True))

        for step in program.steps:
            found = self._results(step.equation, [values[one] for one in step.inputs])
            values.update(zip(step.outputs, found, strict=True))
        return [self._column(values[one]) for one in program.outputs]


class SamplePrinter(CPrinter):
    """Numbers of each sample are vectors, those of all samples are not; see cpp/samples.h."""

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


WEIGHTS, SAMPLE = "const float *w", "const Vec *x, const Vec *u"


class Source:
    """The functions of a field, of its weights and of one sample: x, u, and what its layer returned.

    Attributes:
        order: of the weights; those whose derivative is summed number by number come first.
    """

    def __init__(self, forward: Split, of_sample: Sequence[Shape]):
        self.forward, self.of_sample = forward, list(of_sample)
        self.sizes = [int(np.prod(one.shape)) for one in forward.shapes]
        self.order = tuple(range(len(self.sizes)))
        self.tables = Tables(double=False)
        self.bodies: list[tuple[nodes.Statement, ...]] = []
        self.functions: list[str] = []
        self.products: dict[str, list[tuple[int, int, int]]] = {}  # rows, columns and place of each, by function

    def add_forward(self) -> None:
        """`slope` and `read`, as cpp/rollout.h needs them."""
        program, places = self.forward.program, self.places()
        for name, output in zip(("slope", "read"), program.outputs, strict=True):
            given = f"{WEIGHTS}, {SAMPLE}, const Vec *y, Vec *out"
            self._add(name, given, program.of([output]), places, ("x", "u", "y"), ["out"])

    def add_backward(self) -> Split:
        """`slope_back` and `read_back`, and what they take for weights, as a function of the weights."""
        count, program = len(self.sizes), self.forward.program
        slope, read = (program.of([output]) for output in program.outputs)
        samples = [*self.of_sample, self.of_sample[0], program.shapes[program.outputs[1]]]

        def pulled_back(*arrays):
            *arrays, d_slope, d_read = arrays
            parts = jax.vjp(lambda *arrays: slope(*arrays)[0], *arrays)[1](d_slope)
            return [*parts, *(jax.vjp(lambda *arrays: read(*arrays)[0], *arrays)[1](d_read) if d_read.size else parts)]

        back = split(traced(pulled_back, *self.forward.shapes, *samples), count)
        ways = {"slope_back": back.program.outputs[: count + 3], "read_back": back.program.outputs[count + 3 :]}
        programs = {name: with_factors(back.program.of(outputs), count) for name, outputs in ways.items()}
        # Without a layer there is nothing to read, and `read_back` is never called.
        used = programs if samples[-1].size else {"slope_back": programs["slope_back"]}
        whole = set.intersection(*(set(found) for _, found in used.values()))
        self.order = tuple(sorted(range(count), key=lambda i: i in whole))
        self.summed = sum(size for i, size in enumerate(self.sizes) if i not in whole)
        for name, (program, products) in programs.items():
            self._add_backward(name, program, products, _places([int(np.prod(one.shape)) for one in back.shapes]))
        return back

    def _add_backward(self, name: str, program: Program, products: Products, weights: Sequence[int]) -> None:
        places, at, lines = self.places(), 0, []
        outputs = [f"s{i}" for i in range(len(self.sizes)) if i not in products] + ["dx", "du", "dy"]
        lines += [f"const Sums s{i} = sums + {places[i]};" for i in range(len(self.sizes)) if i not in products]
        self.products[name] = []
        for i, pairs in products.items():
            for rows, columns in pairs:
                lines += [f"const Slots a{at}_ = factors + {at}, b{at}_ = factors + {at + rows};"]
                outputs += [f"a{at}_", f"b{at}_"]
                self.products[name].append((rows, columns, places[i]))
                at += rows + columns
        given = (
            "const Vec *y, const Vec *d_slope, const Vec *d_read, Vec *dx, Vec *du, Vec *dy, Sums sums, Slots factors"
        )
        inputs = "x", "u", "y", "d_slope", "d_read"
        self._add(name, f"{WEIGHTS}, {SAMPLE}, {given}", program, weights, inputs, outputs, lines)

    def places(self) -> list[int]:
        """Where each weight begins."""
        begins = _places([self.sizes[i] for i in self.order])
        return [begins[self.order.index(i)] for i in range(len(self.sizes))]

    def _add(self, name, parameters, program, weights, inputs, outputs, lines=()) -> None:
        """A function of weights, which begin at these places of `w`, and inputs, that fills the outputs."""
        arguments = []
        for i, variable in enumerate(program.inputs):
            array, first = ("w", weights[i]) if i < len(weights) else (inputs[i - len(weights)], 0)
            shape = program.shapes[variable].shape
            arguments.append(Entries(column(Entry(array, first + k) for k in range(int(np.prod(shape)))), shape))
        translation = SampleTranslation(self.tables)
        found = translation.columns(program, arguments)
        pairs = zip(outputs, found, strict=True)
        written = [(out, one) for out, one in pairs if len(one) and not (out[0] == "s" and all(v == 0.0 for v in one))]
        body = translation.body([one for _, one in written], [out for out, _ in written])
        held = sum(one.size for one in nodes.walk(body) if isinstance(one, nodes.Array))
        if len(body) > LONGEST or held > LARGEST:
            raise ValueError(f"its evaluation takes {len(body)} statements and {held} numbers, too many for kernels")
        self.bodies.append(body)
        text = [*(f"    {line}" for line in lines), SamplePrinter(double=False).body(body)]
        self.functions.append(f"void {name}({parameters}) {{\n" + "\n".join(text) + "\n}\n")

    def text(self, constants: dict[str, int], training: bool) -> str:
        """The whole source."""
        printer, read = SamplePrinter(double=False), nodes.names(tuple(self.bodies))
        head = [f"#define LAYER {int(constants['Z'] > 0)}", f"#define TRAINING {int(training)}"]
        head += ['#include "samples.h"', "namespace {"]
        head += [f"constexpr int64_t {name} = {value};" for name, value in constants.items()]
        if training:
            head.append(f"constexpr int64_t S = {self.summed};")
        for name, products in self.products.items():
            listed = ", ".join(f"{{{rows}, {columns}, {place}}}" for rows, columns, place in products)
            head.append(f"constexpr Outer of_{name}[] = {{{listed}{', ' * bool(products)}{{0, 0, 0}}}};")
        tables = [printer.table(name, numbers) for name, numbers in self.tables.numbers.items() if name in read]
        lines = [*head, *(table.replace("real", "float", 1) for table in tables), *self.functions]
        return "\n".join([*lines, "}  // namespace", '#include "rollout.h"', ""])

    def needs_math(self) -> bool:
        """Whether functions of glibc's library of vectors are called."""
        every = (one for one in nodes.walk(tuple(self.bodies)) if isinstance(one, Operation))
        return any(one.name in MATH and one.name not in ("floor", "ceil", "sqrt", "abs", "rem") for one in every)


def _places(sizes: Sequence[int]) -> list[int]:
    return np.cumsum([0, *sizes])[:-1].tolist()
