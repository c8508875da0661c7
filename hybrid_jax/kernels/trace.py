"""Programs of JAX taken apart: what depends on weights alone, what on each sample, and products that weights get."""

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr, Jaxpr, JaxprEqn, Literal, jaxpr_as_fun

INLINED = ("jit", "closed_call", "core_call", "remat2")
OWN_DERIVATIVE = ("custom_jvp_call", "custom_vjp_call")
Shape = jax.ShapeDtypeStruct
Products = dict[int, list[tuple[int, int]]]  # output → rows and columns of each product in its sum
_NUMBERS = itertools.count()


class Step(NamedTuple):
    """An operation on values by their numbers."""

    equation: JaxprEqn
    inputs: tuple[int, ...]
    outputs: tuple[int, ...]


@dataclass(frozen=True)
class Program:
    """Operations one after the other; calls are written out, but for those with a derivative of their own."""

    steps: list[Step]
    inputs: list[int]
    outputs: list[int]
    constants: dict[int, Any]
    shapes: dict[int, Shape] = field(repr=False)

    def __call__(self, *arrays: Any) -> list[Any]:
        """The outputs, by JAX."""
        values = self.constants | dict(zip(self.inputs, arrays, strict=True))
        for step in self.steps:
            found = _evaluated(step.equation, [values[one] for one in step.inputs])
            values.update(zip(step.outputs, found, strict=True))
        return [jnp.asarray(values[one]) for one in self.outputs]

    def of(self, outputs: Sequence[int]) -> "Program":
        """What these outputs need of it."""
        wanted, kept = set(outputs), []
        for step in reversed(self.steps):
            if wanted & set(step.outputs):
                kept.append(step)
                wanted |= set(step.inputs)
        return replace(self, steps=kept[::-1], outputs=list(outputs))


class Split(NamedTuple):
    """A function of parameters and samples as one of weights and samples, with weights a function of parameters."""

    weights: Program
    shapes: list[Shape]  # of the weights
    program: Program

    def place(self, output: int) -> int:
        """Where among all weights a value begins, 0 if it is of no size; ValueError if it is none of them."""
        if not self.program.shapes[output].size:
            return 0
        if output not in self.weights.outputs:
            raise ValueError("the weights before its batch normalisation are not learned")
        return sum(one.size for one in self.shapes[: self.weights.outputs.index(output)])


def traced(function: Callable, *shapes: Any) -> Program:
    """The program of a function of arrays that returns a list."""
    closed = jax.make_jaxpr(function)(*shapes)
    made = Program([], [next(_NUMBERS) for _ in closed.jaxpr.invars], [], {}, {})
    made.outputs.extend(_add(made, closed.jaxpr, closed.consts, made.inputs))
    return made


def _add(made: Program, jaxpr: Jaxpr, constants: Sequence[Any], inputs: Sequence[int]) -> list[int]:
    """Append the operations of a program; the numbers of its outputs."""
    names: dict[Any, int] = dict(zip(jaxpr.invars, inputs, strict=True))

    def constant(value) -> int:
        number = next(_NUMBERS)
        made.constants[number], made.shapes[number] = value, Shape(np.shape(value), _dtype(value))
        return number

    def read(atom) -> int:
        return constant(atom.val) if isinstance(atom, Literal) else names[atom]

    names.update({variable: constant(value) for variable, value in zip(jaxpr.constvars, constants, strict=True)})

    for equation in jaxpr.eqns:
        given = [read(atom) for atom in equation.invars]
        if equation.primitive.name in INLINED:
            inner = equation.params["jaxpr"]
            closed = isinstance(inner, ClosedJaxpr)
            outs = _add(made, inner.jaxpr if closed else inner, inner.consts if closed else (), given)
        else:
            outs = [next(_NUMBERS) for _ in equation.outvars]
            made.steps.append(Step(equation, tuple(given), tuple(outs)))
        names.update(zip(equation.outvars, outs, strict=True))
    made.shapes.update({number: Shape(one.aval.shape, one.aval.dtype) for one, number in names.items()})
    return [read(atom) for atom in jaxpr.outvars]


def split(program: Program, parameters: int) -> Split:
    """A program apart, whose first so many inputs are parameters; the others are samples."""
    known, constant = set(program.inputs[:parameters]), set(program.constants)
    ahead, after, wanted = [], [], []
    for step in program.steps:
        read = set(step.inputs)
        if read <= constant:
            constant |= set(step.outputs)
            ahead.append(step)
            after.append(step)
        elif read <= constant | known:
            known |= set(step.outputs)
            ahead.append(step)
        else:
            wanted += [one for one in step.inputs if one in known]
            after.append(step)
    frontier = list(dict.fromkeys([*wanted, *(one for one in program.outputs if one in known)]))
    shapes = [program.shapes[one] for one in frontier]
    weights = replace(program, steps=ahead, inputs=program.inputs[:parameters]).of(frontier)
    samples = replace(program, steps=after, inputs=[*frontier, *program.inputs[parameters:]])
    return Split(weights, shapes, samples.of(program.outputs))


def with_factors(program: Program, count: int) -> tuple[Program, Products]:
    """The program with, behind the other outputs, a and b in place of those of the first `count` that are Σ a bᵀ."""
    made = {out: step for step in program.steps for out in step.outputs}
    found = {i: pairs for i in range(count) if (pairs := _factors(program, program.outputs[i], made))}
    outs = [out for i, out in enumerate(program.outputs) if i not in found]
    outs += [factor for pairs in found.values() for pair in pairs for factor in pair]
    sizes = {i: [tuple(program.shapes[one].shape[0] for one in pair) for pair in pairs] for i, pairs in found.items()}
    return program.of(outs), sizes  # pyright: ignore[reportReturnType]


def _factors(program: Program, out: int, made: dict[int, Step]) -> list[tuple[Any, Any]]:
    """Each a and b of an array that is Σ a bᵀ; none if it is not."""
    if (step := made.get(out)) is None:
        return []
    name, inputs = step.equation.primitive.name, step.inputs
    if name == "transpose":
        return [(b, a) for a, b in _factors(program, inputs[0], made)]
    if name == "add_any":
        parts = [_factors(program, one, made) for one in inputs]
        return [pair for part in parts for pair in part] if all(parts) else []
    outer = name == "dot_general" and step.equation.params["dimension_numbers"] == (((), ()), ((), ()))
    vectors = all(len(program.shapes[one].shape) == 1 for one in inputs)
    return [(inputs[0], inputs[1])] if outer and vectors else []


def _evaluated(equation: JaxprEqn, inputs: list[Any]) -> Sequence[Any]:
    if equation.primitive.name in OWN_DERIVATIVE:
        values = {
            atom: value for atom, value in zip(equation.invars, inputs, strict=True) if not isinstance(atom, Literal)
        }
        program = Jaxpr((), list(values), equation.outvars, [equation], debug_info=_NAMELESS)
        return jaxpr_as_fun(ClosedJaxpr(program, ()))(*values.values())
    found = equation.primitive.bind(*inputs, **equation.params)
    return found if equation.primitive.multiple_results else [found]


def _dtype(value: Any):
    return value.dtype if hasattr(value, "dtype") else np.result_type(value)


_NAMELESS = jax.make_jaxpr(lambda: ())().jaxpr.debug_info
