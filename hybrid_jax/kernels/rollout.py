"""Rollouts of many windows by a field's kernel: one call for all intervals, and one for the derivative."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hybrid_jax.integrate import RK4, Solver, rollout_batch
from hybrid_jax.kernels import library
from hybrid_jax.kernels.fields import Kernel, kernel_of

Shaped = Array | np.ndarray | jax.ShapeDtypeStruct
FEWEST = 16  # windows; for fewer, a call costs more than it saves


def serves_training(field, x0: Shaped, u: Shaped, solver: Solver, windows_axis: int) -> bool:
    """Whether `trained` supports a minibatch of these shapes with windows along an axis."""
    return _kernel(field, x0, u, solver, windows_axis, True) is not None


def trained(
    field, x0: Float[Array, "d b"], u: Float[Array, "t m b"], dt: float, solver: Solver, plain: Callable
) -> Any:
    """Return the trajectories (t, d, b) of a minibatch in training mode, or None without a kernel.

    `plain` computes them in JAX. Derivatives with respect to u, which kernels lack, are its own.
    """
    if (kernel := _kernel(field, x0, u, solver, -1, True)) is None:
        return None

    def run(field, x0, u):
        return _rollout(kernel, float(dt), kernel.weights(field), x0, u)

    def derivative(values, slopes):
        return eqx.filter_jvp(run if slopes[-1] is None else plain, values, slopes)

    return _with_derivative(run, derivative)(field, x0, u)


def predicted(field, x0: Array | np.ndarray, u: Array | np.ndarray, dt: float, solver: Solver) -> Any:
    """Return the trajectories (n, t, d) for x0 (n, d), u (n, t, m) in inference mode, or None without a kernel."""
    if (kernel := _kernel(field, x0, u, solver, 0, False)) is None:
        return None

    def run(field, *arrays):
        last = (jnp.moveaxis(array, 0, -1) for array in arrays)
        return jnp.moveaxis(_states(kernel, float(dt), 0, kernel.weights(field), *last)[0], -1, 0)

    def plain(field, x0, u):
        return rollout_batch(field, x0, u, dt, solver)

    return _with_derivative(run, partial(eqx.filter_jvp, plain))(field, x0, u)


def _with_derivative(run: Callable, derivative: Callable) -> Callable:
    made = eqx.filter_custom_jvp(run)
    made.def_jvp(derivative)
    return lambda field, *arrays: made(field, *map(jnp.asarray, arrays))


def _kernel(field, x0: Shaped, u: Shaped, solver: Solver, axis: int, training: bool) -> Kernel | None:
    """Return the kernel for these arrays, after checks of their shapes, which it lacks."""
    if type(solver) is not RK4 or solver.substeps != 1 or (x0.ndim, u.ndim) != (2, 3):
        return None
    if x0.shape[axis] != u.shape[axis] or x0.shape[axis] < FEWEST or library.obstacle() is not None:
        return None
    if any(leaf.dtype != jnp.float32 for leaf in (*jax.tree.leaves(eqx.filter(field, eqx.is_inexact_array)), x0, u)):
        return None
    return kernel_of(field, x0.shape[1 + axis], u.shape[2 + axis], training)


@partial(jax.custom_vjp, nondiff_argnums=(0, 1))
def _rollout(kernel: Kernel, dt: float, *arrays: Array) -> Float[Array, "t d b"]:
    """Compute the states from weights, x0 and u by one call forward and one backward, which takes u for data."""
    return _states(kernel, dt, 0, *arrays)[0]


def _forward(kernel: Kernel, dt: float, *arrays: Array):
    (d, _, _, units), (x0, u), width = kernel.sizes, arrays[-2:], library.width()
    windows, padded = (-(-n // width) * width for n in (x0.shape[1], units))
    kept = len(u) * 4 * (windows * (d + units + 1) + padded) + width  # see cpp/rollout.h
    states, saved = _states(kernel, dt, kept, *arrays)
    return states, (*arrays, saved)


def _backward(kernel: Kernel, dt: float, saved: tuple[Array, ...], d_states: Float[Array, "t d b"]):
    *given, kept = saved
    shapes = [array.shape for array in given[:2]]
    return *_call("backward", kernel, dt, shapes, *given, kernel.back_weights(given[0]), kept, d_states), None


_rollout.defvjp(_forward, _backward)


def _states(kernel: Kernel, dt: float, kept: int, *arrays: Array) -> Sequence[Array]:
    """Return the states, and `kept` numbers that the backward pass needs."""
    return _call("forward", kernel, dt, [(len(arrays[-1]), *arrays[-2].shape), (kept,)], *arrays)


def _call(way: str, kernel: Kernel, dt: float, shapes: list[tuple[int, ...]], *arrays: Array) -> Sequence[Array]:
    """Call the kernel on arrays, which it does not check. `vmap` calls it for one lane after the other."""
    results = [jax.ShapeDtypeStruct(shape, jnp.float32) for shape in shapes]
    call = jax.ffi.ffi_call(f"hybrid_jax_{way}", results, vmap_method="sequential")
    return call(*arrays, kernel=kernel.name, numbers=np.array([dt, kernel.epsilon], np.float32))
