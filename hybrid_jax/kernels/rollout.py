"""Rollouts of many windows by a field's kernel: one call for all intervals, and one for the derivative."""

from collections.abc import Callable
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import ShapedArray
from jax.extend.core import Primitive, jaxpr_as_fun
from jax.interpreters import batching, mlir
from jaxtyping import Array, Float

from hybrid_jax.integrate import RK4, Solver, integrate
from hybrid_jax.kernels import library
from hybrid_jax.kernels.fields import REFUSED, Kernel, kernel_of
from hybrid_jax.networks.normalisation import row_means

Shaped = Array | np.ndarray | jax.ShapeDtypeStruct
VECTOR = 16  # numbers in a vector, at most: of windows the kernels take at least so many


def serves_training(field, x0: Shaped, u: Shaped, solver: Solver, windows_axis: int) -> bool:
    """Whether `trained` supports a minibatch of these shapes with windows along an axis."""
    return _kernel(field, x0, u, solver, windows_axis, True) is not None


def trained(field, x0: Float[Array, "d b"], u: Float[Array, "t m b"], dt: float, solver: Solver) -> Any:
    """Return the trajectories (t, d, b) of a minibatch in training mode, or None without a kernel."""
    if (kernel := _kernel(field, x0, u, solver, -1, True)) is None:
        return None
    return _rollout((kernel, float(dt)), kernel.weights(field), jnp.asarray(x0), jnp.asarray(u))


def predicted(field, x0: Array | np.ndarray, u: Array | np.ndarray, dt: float, solver: Solver):
    """Return the trajectories (n, t, d) for x0 (n, d), u (n, t, m) in inference mode, or None without a kernel."""
    if (kernel := _kernel(field, x0, u, solver, 0, False)) is None:
        return None
    last = jnp.moveaxis(jnp.asarray(x0), 0, -1), jnp.moveaxis(jnp.asarray(u), 0, -1)
    return jnp.moveaxis(_called((kernel, float(dt)), 0, kernel.weights(field), *last)[0], -1, 0)


def _kernel(field, x0: Shaped, u: Shaped, solver: Solver, axis: int, training: bool) -> Kernel | None:
    """Return the kernel for these arrays, whose shapes it does not check itself."""
    if type(solver) is not RK4 or solver.substeps != 1 or (x0.ndim, u.ndim) != (2, 3):
        return None
    if x0.shape[axis] != u.shape[axis] or x0.shape[axis] < VECTOR or library.obstacle() is not None:
        return None
    if any(leaf.dtype != jnp.float32 for leaf in (*jax.tree.leaves(eqx.filter(field, eqx.is_inexact_array)), x0, u)):
        return None
    return kernel_of(field, x0.shape[1 + axis], u.shape[2 + axis], training)


@partial(jax.custom_vjp, nondiff_argnums=(0,))
def _rollout(kernel_and_dt: tuple[Kernel, float], *arrays: Array) -> Float[Array, "t d b"]:
    """Compute `_plain` by one call forward and one backward."""
    return _called(kernel_and_dt, 0, *arrays)[0]


def _plain(kernel_and_dt: tuple[Kernel, float], weights: Array, x0: Array, u: Array):
    kernel, dt = kernel_and_dt

    def evaluate(x, u, n):
        one = partial(jaxpr_as_fun(kernel.forward.program), *kernel.apart(weights))
        return jax.vmap(one, in_axes=-1, out_axes=-1)(x, u, n)

    def field(x, u):
        n = jnp.zeros((kernel.sizes.units, x.shape[1]), x.dtype)
        if len(n):
            _, z, weight, gain, shift = evaluate(x, u, n)
            h = weight[..., 0] @ (z - row_means(z)[:, None])
            q = jax.lax.rsqrt(row_means(jnp.square(h)) + kernel.epsilon)
            n = gain * q[:, None] * h + shift
        return evaluate(x, u, n)[0]

    return integrate(field, x0, u, dt, RK4())


def _called(kernel_and_dt: tuple[Kernel, float], kept: int, *arrays: Array) -> list[Array]:
    """Return the states and the `kept` numbers per evaluation for the backward pass."""
    (kernel, dt), x0, u = kernel_and_dt, *arrays[-2:]
    results = [jax.ShapeDtypeStruct(shape, x0.dtype) for shape in ((len(u), *x0.shape), (kept,))]

    def plain(*arrays):
        return [_plain(kernel_and_dt, *arrays), jnp.zeros(kept, x0.dtype)]

    return _call((kernel, "forward", dt), results, plain, *arrays)


def _call(target: tuple[Kernel, str, float], results: list, plain: Callable, *arrays: Array) -> Any:
    """Call a kernel on arrays, which it does not check; it is differentiated as `plain`, and `vmap` makes one call."""
    call = jax.custom_jvp(partial(_CALL.bind, target=target, results=tuple(results), plain=plain))
    call.defjvp(lambda arrays, tangents: jax.jvp(plain, arrays, tangents))
    return call(*arrays)


_CALL = Primitive("kernel")  # as `jax.ffi.ffi_call`, but the library may be compiled until it is lowered
_CALL.multiple_results = True
_CALL.def_impl(lambda *arrays, **given: jax.jit(partial(_CALL.bind, **given))(*arrays))
_CALL.def_abstract_eval(lambda *_, results, **__: [ShapedArray(one.shape, one.dtype) for one in results])


def _lowered(context, *arrays, target, results, plain):
    """Wait for the library. Without it, JAX does the same."""
    kernel, handler, dt = target
    try:
        rule = jax.ffi.ffi_lowering(kernel.prefix.result() + handler)
    except library.Unusable as error:
        REFUSED[kernel.name] = str(error)
        return mlir.lower_fun(plain, multiple_results=True)(context, *arrays)
    return rule(context, *arrays, numbers=np.array([dt, kernel.epsilon], np.float32))


def _batched(arrays, axes, *, target, results, plain):
    """Make one call for all lanes, which are the first axis of all arrays."""
    (lanes,) = {array.shape[axis] for array, axis in zip(arrays, axes, strict=True) if axis is not None}
    whole = [batching.bdim_at_front(array, axis, lanes) for array, axis in zip(arrays, axes, strict=True)]
    wide = tuple(jax.ShapeDtypeStruct((lanes, *one.shape), one.dtype) for one in results)
    return _CALL.bind(*whole, target=target, results=wide, plain=jax.vmap(plain)), [0] * len(results)


mlir.register_lowering(_CALL, _lowered)
batching.primitive_batchers[_CALL] = _batched


def _forward(kernel_and_dt: tuple[Kernel, float], *arrays: Array):
    (d, _, _, units), (x0, u) = kernel_and_dt[0].sizes, arrays[-2:]
    windows, scales = (-(-count // VECTOR) * VECTOR for count in (x0.shape[1], units))  # in whole vectors
    kept = len(u) * 4 * (windows * (d + units + 1) + scales) + VECTOR  # see cpp/rollout.h
    states, saved = _called(kernel_and_dt, kept, *arrays)
    return states, (*arrays, saved)


def _backward(kernel_and_dt: tuple[Kernel, float], saved: tuple[Array, ...], d_states: Float[Array, "t d b"]):
    kernel, dt = kernel_and_dt
    results = [jax.ShapeDtypeStruct(array.shape, array.dtype) for array in saved[:-1]]

    def plain(*arrays):
        *arrays, _, _, d_states = arrays
        return jax.vjp(partial(_plain, kernel_and_dt), *arrays)[1](d_states)

    *given, kept = saved
    given += [kernel.back_weights(given[0]), kept, d_states]
    return tuple(_call((kernel, "backward", dt), results, plain, *given))


_rollout.defvjp(_forward, _backward)
