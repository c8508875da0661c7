"""Split JAX programs into a part for the weights, a part for each sample, and products for weight gradients."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr, JaxprEqn, Literal, Var, jaxpr_as_fun
from jax.interpreters.partial_eval import dce_jaxpr

Shape = jax.ShapeDtypeStruct
Products = dict[int, list[tuple[int, int]]]  # output → rows and columns of each product in its sum


class Split(NamedTuple):
    """A function of parameters and samples, split into weights(parameters) and a program of weights and samples."""

    weights: ClosedJaxpr
    program: ClosedJaxpr
    shapes: list[Any]  # of the weights

    def places(self) -> list[int]:
        """Return where each weight begins in the concatenation of all."""
        return np.cumsum([0, *(one.size for one in self.shapes)])[:-1].tolist()

    def joined(self, parameters: Sequence[Any]) -> jax.Array:
        return jnp.concatenate([jnp.zeros(0, jnp.float32), *map(jnp.ravel, jaxpr_as_fun(self.weights)(*parameters))])

    def place(self, output: int) -> int:
        """Return where an output begins among all weights, 0 if it is empty; ValueError if it is not a weight."""
        found, weights = self.program.jaxpr.outvars[output], self.program.jaxpr.invars[: len(self.shapes)]
        if not found.aval.size:  # pyright: ignore[reportAttributeAccessIssue]
            return 0
        if found not in weights:
            raise ValueError("the weights before its batch normalisation are not learned")
        return self.places()[weights.index(found)]  # pyright: ignore[reportArgumentType]


def traced(function: Callable, *shapes: Any) -> ClosedJaxpr:
    """Trace a function of arrays and inline its calls."""
    with jax.disable_jit():
        return jax.make_jaxpr(function)(*shapes)


def outputs_of(program: ClosedJaxpr, outputs: Sequence[Any]) -> ClosedJaxpr:
    """Reduce a program to these outputs, given as values or indices."""
    outs = [program.jaxpr.outvars[one] if isinstance(one, int) else one for one in outputs]
    return _program(program.jaxpr.eqns, program.jaxpr.invars, outs, program)


def _variables(atoms: Sequence[Any]) -> list[Var]:
    return [one for one in atoms if not isinstance(one, Literal)]


def _program(equations: Sequence[JaxprEqn], inputs: Sequence[Var], outputs: Sequence[Any], of: ClosedJaxpr):
    jaxpr = of.jaxpr.replace(invars=list(inputs), outvars=list(outputs), eqns=list(equations))
    return ClosedJaxpr(dce_jaxpr(jaxpr, True, instantiate=True)[0], of.consts)


def split(program: ClosedJaxpr, parameters: int) -> Split:
    """Split a program whose first `parameters` inputs are parameters and whose others are samples.

    Weights are in single precision, so functions of parameters of another type, for example comparisons, belong to the
    samples.
    """
    inputs, outputs, equations = program.jaxpr.invars, program.jaxpr.outvars, program.jaxpr.eqns
    constant, known, wanted = set(program.jaxpr.constvars), set(inputs[:parameters]), []
    for equation in equations:
        read = _variables(equation.invars)
        if constant.issuperset(read):
            constant |= set(equation.outvars)
        elif (constant | known).issuperset(read) and all(out.aval.dtype.kind == "f" for out in equation.outvars):  # type: ignore
            known |= set(equation.outvars)
        else:
            wanted += [one for one in read if one in known]
    frontier = list(dict.fromkeys([*wanted, *(one for one in _variables(outputs) if one in known)]))
    weights = _program(equations, inputs[:parameters], frontier, program)
    after = [equation for equation in equations if known.isdisjoint(equation.outvars)]
    samples = _program(after, [*frontier, *inputs[parameters:]], outputs, program)
    return Split(weights, samples, [one.aval for one in frontier])


def with_factors(program: ClosedJaxpr, count: int) -> tuple[ClosedJaxpr, Products]:
    """Replace the first `count` outputs that are Σ a bᵀ by a and b, appended to the other outputs."""
    made = {out: equation for equation in program.jaxpr.eqns for out in equation.outvars}
    outputs = program.jaxpr.outvars
    found = {i: pairs for i in range(count) if (pairs := _factors(outputs[i], made))}
    outs = [out for i, out in enumerate(outputs) if i not in found]
    outs += [factor for pairs in found.values() for pair in pairs for factor in pair]
    sizes = {i: [(a.aval.size, b.aval.size) for a, b in pairs] for i, pairs in found.items()}
    return outputs_of(program, outs), sizes


def _factors(out: Any, made: dict[Any, JaxprEqn]) -> list[tuple[Any, Any]]:
    """Return all pairs a, b of an array Σ a bᵀ, or [] for another array."""
    if isinstance(out, Literal) or out not in made:
        return []
    equation = made[out]
    name, inputs = equation.primitive.name, equation.invars
    if name == "transpose":
        return [(b, a) for a, b in _factors(inputs[0], made)]
    if name == "add_any":
        parts = [_factors(one, made) for one in inputs]
        return [pair for part in parts for pair in part] if all(parts) else []
    outer = name == "dot_general" and equation.params["dimension_numbers"] == (((), ()), ((), ()))
    vectors = all(len(one.aval.shape) == 1 for one in inputs)  # pyright: ignore[reportAttributeAccessIssue]
    return [(inputs[0], inputs[1])] if outer and vectors else []
