"""Generate kernels from fields, as source code for one sample.

A field is split into weights, functions of its parameters that JAX evaluates once per rollout, and a program of one
sample of these, x and u: forward, and backward by `jax.vjp`. Batch normalisation couples samples, so the program also
takes its result n and returns z and the weights W, γ and β besides ẋ; see cpp/rollout.h.
"""

from dataclasses import dataclass
from itertools import product
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PyTree

from hybrid_jax.dynamics.base import parts_of
from hybrid_jax.dynamics.batching import batch_norms
from hybrid_jax.kernels import library
from hybrid_jax.kernels.source import Source
from hybrid_jax.kernels.trace import Shape, Split, split, traced
from hybrid_jax.networks.normalisation import AbstractNorm, BatchNorm

MOST = 20_000  # weights; more would take long to translate
UNSUPPORTED: dict[str, str] = {}  # name of a field → why it has no kernel


class Sizes(NamedTuple):
    """Sizes of x, u, and the input and output of the layer with batch normalisation, or 0."""

    d: int
    m: int
    reads: int = 0
    units: int = 0


@dataclass(frozen=True, eq=False)
class Kernel:
    """The name by which programs find a field's kernel, and the conversion of its arrays to weights."""

    name: str
    sizes: Sizes
    forward: Split
    back: Split | None
    epsilon: float

    def weights(self, field: PyTree) -> Array:
        return self.forward.joined(jax.tree.leaves(eqx.filter(field, _is_array)))

    def back_weights(self, weights: Array) -> Array:
        assert self.back is not None
        parts = zip(jnp.split(weights, self.forward.places()[1:]), self.forward.shapes, strict=False)
        return self.back.joined([part.reshape(one.shape) for part, one in parts])


def kernel_of(field: PyTree, d: int, m: int, training: bool) -> Kernel | None:
    """Return the kernel of a field with d states and m inputs, or None with the reason in `UNSUPPORTED`."""
    shapes = jax.tree.map(lambda leaf: Shape(jnp.shape(leaf), leaf.dtype) if _is_array(leaf) else leaf, field)
    leaves, structure = jax.tree.flatten(shapes)
    key = *leaves, structure, d, m
    try:
        if (known := _KNOWN.get((*key, True))) is None or known.sizes.units:  # else training's kernel also predicts
            if (*key, training) not in _KNOWN:
                _KNOWN[*key, training] = None  # if it fails, it is not tried again
                _check_methods(shapes)
                with jax.ensure_compile_time_eval():  # JAX may be tracing a program
                    _KNOWN[*key, training] = _made(shapes, Sizes(d, m), training)
            known = _KNOWN[*key, training]
    except Exception as error:  # a user's code may raise anything, or not be hashable
        reason = str(error) if isinstance(error, ValueError) else f"{type(error).__name__}: {error}"
        UNSUPPORTED[_name(field)] = reason.removeprefix("field: ").partition("\n")[0]
        return None
    return known


_KNOWN: dict[Any, Kernel | None] = {}


def _name(field: Any) -> str:
    """Name the class of a field with its modules' classes, or a function."""
    parts = vars(field).values() if isinstance(field, eqx.Module) else ()
    modules = ", ".join(_name(part) for part in parts if isinstance(part, eqx.Module))
    own = getattr(field, "__qualname__", type(field).__name__)
    return f"{own}({modules})" if modules else own


def _made(field: PyTree, sizes: Sizes, training: bool) -> Kernel:
    """Make the kernel of a field whose arrays are replaced by shapes."""
    arrays, rest = eqx.partition(field, lambda leaf: isinstance(leaf, Shape))
    (shapes, structure), norms = jax.tree.flatten(arrays), batch_norms(field) if training else []
    if len(norms) > 1 or not all(isinstance(norm, BatchNorm) for norm in norms):
        raise ValueError("it has more than one batch normalisation, or another class than BatchNorm")
    epsilon, units = (norms[0].epsilon, norms[0].gain.size) if norms else (0.0, 0)  # pyright: ignore[reportAttributeAccessIssue]
    of_sample = [Shape((size,), jnp.float32) for size in (sizes.d, sizes.m, units)]

    def evaluate(*arrays):
        """Return ẋ for a given result n of batch normalisation, and its inputs z, W, γ and β."""
        *arrays, x, u, n = arrays
        whole = eqx.combine(jax.tree.unflatten(structure, arrays), rest)
        if not norms:
            return [whole(x, u), n, jnp.zeros((0, 0), n.dtype), n, n]
        norm, read = batch_norms(whole)[0], []
        given = _Given(norm, n, read.append)
        probed = jax.tree.map(lambda node: given if node is norm else node, whole, is_leaf=lambda node: node is norm)
        slope = probed(x, u)
        if len(read) != 1:
            raise ValueError(f"its batch normalisation is evaluated {len(read)} times")
        return [slope, *read[0]]

    forward = split(traced(evaluate, *shapes, *of_sample), len(shapes))
    slope, read, weight, *_ = forward.program.out_avals
    if (slope.shape, slope.dtype) != ((sizes.d,), jnp.float32):
        raise ValueError(f"it returns {slope.str_short()}")
    if weight.shape != (units, *read.shape):
        raise ValueError(f"its batch normalisation is of {weight.shape} weights and of {read.shape} numbers")
    if any(one.dtype != jnp.float32 for one in forward.shapes):
        raise ValueError("its numbers are not all in single precision")
    if (count := sum(one.size for one in forward.shapes)) > MOST:
        raise ValueError(f"it has {count} weights, more than {MOST}")
    sizes, source = sizes._replace(reads=read.size, units=units), Source(forward, of_sample, training)
    constants = dict(zip("DMZH", sizes, strict=True)) | {"P": count}
    constants |= {name: forward.place(i) for i, name in enumerate(("WEIGHT", "GAIN", "SHIFT"), start=2)}
    return Kernel(library.begun(source.text(constants)), sizes, forward, source.back, epsilon)


class _Given(AbstractNorm):
    """Replaces batch normalisation: passes its arguments on and returns a given result."""

    norm: Any
    normal: Array
    tell: Any = eqx.field(static=True)

    def infer(self, weight, z):
        self.tell([z, weight, self.norm.gain, self.norm.shift])
        return self.normal


def _check_methods(field: Any) -> None:
    """Reject a field with a user-defined batched method, which may differ from the method for one sample."""
    for part, method in product(parts_of(field), ("train_batch", "infer_batch")):
        own = getattr(type(part), method, None)
        if own is not None and not own.__module__.startswith("hybrid_jax."):
            raise ValueError(f"{type(part).__name__} has a {method} of its own")


def _is_array(leaf: Any) -> bool:
    return isinstance(leaf, np.ndarray) or eqx.is_array(leaf)
