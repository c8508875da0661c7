"""Fields as kernels: what a field computes of one sample, as source, and the layers around batch normalisation apart.

A field is taken apart into weights, functions of what it learns that JAX evaluates once a rollout, and a program of one
sample of these, x and u: forward, and backward by `jax.vjp`. Batch normalisation couples samples, so the layers around
it are written by hand (cpp/layer.h): the program then returns what they read beside ẋ, which is of what they return, y.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PyTree

from hybrid_jax.dynamics.batching import batch_norms
from hybrid_jax.kernels import library
from hybrid_jax.kernels.source import Source
from hybrid_jax.kernels.trace import Shape, Split, split, traced
from hybrid_jax.networks.mlp import ResidualNetwork
from hybrid_jax.networks.normalisation import BatchNorm

UNITS = 32  # hidden units that the layer works on at once, at most: their number is a multiple of it
MOST = 20_000  # weights: more take long to translate
REFUSED: dict[str, str] = {}  # name of a field → why there is no kernel for it


class Sizes(NamedTuple):
    """Numbers of x, of u, and of what the layer reads, has of units and returns, or 0."""

    d: int
    m: int
    reads: int = 0
    units: int = 0
    returns: int = 0


@dataclass(frozen=True, eq=False)
class Kernel:
    """What serves a field: the library, and how the field's arrays become its weights."""

    prefix: str
    sizes: Sizes
    forward: Split
    back: Split | None
    order: tuple[int, ...]  # of the weights, as the library has them
    epsilon: float

    def weights(self, field: PyTree) -> Array:
        """The weights of a field in one array."""
        weights = self.forward.weights(*jax.tree.leaves(eqx.filter(field, _is_array)))
        return joined([weights[i] for i in self.order])

    def apart(self, weights: Array) -> list[Array]:
        """The weights from one array."""
        shapes = [self.forward.shapes[i].shape for i in self.order]
        ends = np.cumsum([0, *(int(np.prod(shape)) for shape in shapes)]).tolist()
        parts = [weights[start:end].reshape(s) for start, end, s in zip(ends, ends[1:], shapes, strict=False)]
        return [parts[self.order.index(i)] for i in range(len(parts))]

    def back_weights(self, weights: Array) -> Array:
        """Those of the way back."""
        assert self.back is not None
        return joined(self.back.weights(*self.apart(weights)))

    def evaluate(self, weights: Array, x: Array, u: Array, y: Array) -> list[Array]:
        """ẋ and what the layer reads, of one sample."""
        return self.forward.program(*self.apart(weights), x, u, y)


def joined(arrays: Sequence[Array]) -> Array:
    return jnp.concatenate([jnp.zeros(0, jnp.float32), *(jnp.ravel(one) for one in arrays)])


def layer_of(field: PyTree) -> ResidualNetwork | None:
    """The network whose batch normalisation couples samples, if any; ValueError if it is not one for kernels."""
    if not (norms := batch_norms(field)):
        return None
    networks = [node for node in _networks(field) if isinstance(node.norm, BatchNorm)]
    if len(norms) > 1 or len(networks) != 1:
        raise ValueError("its batch normalisation is not that of one residual network")
    (network,) = networks
    if network.activation != "relu" or len(network.weight_in) % UNITS:
        raise ValueError(f"its batch normalisation is not followed by ReLU, or its units are no multiple of {UNITS}")
    return network


def kernel_of(field: PyTree, d: int, m: int, training: bool) -> Kernel | None:
    """The kernel of a field of d states and m inputs, or None; `REFUSED` then has the reason."""
    arrays, rest = eqx.partition(field, _is_array)
    shapes, structure = jax.tree.flatten(jax.tree.map(lambda leaf: Shape(jnp.shape(leaf), leaf.dtype), arrays))
    static, frame = jax.tree.flatten(rest)
    try:
        key = tuple((*one.shape, str(one.dtype)) for one in shapes), structure, tuple(static), frame, d, m, training
        if key not in _KNOWN:
            with jax.ensure_compile_time_eval():  # this may be inside of a program that JAX traces
                _KNOWN[key] = _made(eqx.combine(jax.tree.unflatten(structure, shapes), rest), Sizes(d, m), training)
    except Exception as error:  # a user's code may raise anything
        known = isinstance(error, ValueError | library.Unusable)
        reason = str(error) if known else f"{type(error).__name__}: {error}"
        REFUSED[type(field).__name__] = reason.removeprefix("field: ").partition("\n")[0]
        return None
    return _KNOWN[key]


_KNOWN: dict[Any, Kernel] = {}


def _made(field: PyTree, sizes: Sizes, training: bool) -> Kernel:
    """The kernel of a field of shapes in place of arrays."""
    _check_methods(field, "train_batch" if training else "infer_batch")
    shapes, structure = jax.tree.flatten(eqx.filter(field, _is_shape))
    rest, network, epsilon = eqx.filter(field, _is_shape, inverse=True), layer_of(field) if training else None, 0.0
    if network is not None:
        (units, reads), (returns,), epsilon = network.weight_in.shape, network.bias_out.shape, network.norm.epsilon  # pyright: ignore
        sizes = Sizes(sizes.d, sizes.m, reads, units, returns)
    of_sample = [Shape((size,), jnp.float32) for size in (sizes.d, sizes.m, sizes.returns)]

    def evaluate(*arrays):
        whole = eqx.combine(jax.tree.unflatten(structure, arrays[:-3]), rest)
        return _with_reading(whole, *arrays[-3:]) if network else [whole(*arrays[-3:-1]), jnp.zeros(0, jnp.float32)]

    program = traced(evaluate, *shapes, *of_sample)
    slope = program.shapes[program.outputs[0]]
    if (slope.shape, slope.dtype) != ((sizes.d,), jnp.float32):
        raise ValueError(f"it returns {slope}")
    forward = split(program, len(shapes))
    if any(one.dtype != jnp.float32 for one in forward.shapes):
        raise ValueError("its numbers are not all in single precision")
    if (count := sum(int(np.prod(one.shape)) for one in forward.shapes)) > MOST:
        raise ValueError(f"it has {count} weights, more than {MOST}")
    source = Source(forward, of_sample)
    back = source.add_backward() if training else None
    source.add_forward()
    constants = dict(zip(("D", "M", "Z", "H", "Y"), sizes, strict=True)) | {"P": count}
    prefix = library.compiled(source.text(constants, training), source.needs_math())
    return Kernel(prefix, sizes, forward, back, source.order, epsilon)


class _Reader(ResidualNetwork):
    """In place of a network with batch normalisation: it tells what it reads, and returns what it is given."""

    returned: Array = eqx.field(default=None)  # pyright: ignore[reportAssignmentType]
    tell: Any = eqx.field(static=True, default=None)

    def __call__(self, x, u):
        self.tell(self.inputs(x, u))
        return self.scaling.outputs(self.returned)


def _with_reading(field: PyTree, x: Array, u: Array, y: Array) -> list[Array]:
    """ẋ, where the network with batch normalisation returns y, and what it reads."""
    read: list[Array] = []
    (network,) = [node for node in _networks(field) if isinstance(node.norm, BatchNorm)]
    parts = {one.name: getattr(network, one.name) for one in fields(ResidualNetwork)}
    reader = _Reader(**parts, returned=y, tell=read.append)
    whole = jax.tree.map(lambda node: reader if node is network else node, field, is_leaf=lambda node: node is network)
    slope = whole(x, u)
    if len(read) != 1:
        raise ValueError(f"its batch normalisation is evaluated {len(read)} times")
    return [slope, read[0]]


def _networks(field: PyTree) -> list[ResidualNetwork]:
    def is_network(node) -> bool:
        return isinstance(node, ResidualNetwork)

    return [node for node in jax.tree.leaves(field, is_leaf=is_network) if is_network(node)]


def _check_methods(node: Any, method: str) -> None:
    """Refuse a field with a batched form of a user's own, which may be another function than that of one sample."""
    own = getattr(type(node), method, None)
    if own is not None and not own.__module__.startswith("hybrid_jax."):
        raise ValueError(f"{type(node).__name__} has a {method} of its own")
    parts = vars(node).values() if isinstance(node, eqx.Module) else node if isinstance(node, tuple | list) else ()
    for part in node.values() if isinstance(node, dict) else parts:
        _check_methods(part, method)


def _is_array(leaf: Any) -> bool:
    return isinstance(leaf, np.ndarray) or eqx.is_array(leaf)


def _is_shape(leaf: Any) -> bool:
    return isinstance(leaf, Shape)
