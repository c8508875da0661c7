"""Checks of arguments: each raises a one-line ValueError that names the argument; traced arrays are not checked."""

import errno
import math
import sys
import tempfile
import warnings
from collections.abc import Iterable
from pathlib import Path
from typing import Any, TypeVar

import jax
import jax.core
import jax.numpy as jnp
import numpy as np

Numbers = jax.Array | np.ndarray
T = TypeVar("T")

LONGEST = 300  # characters of another error's message that ours quotes
UNIT = 1e-2  # tolerance of |q| = 1: far above rounding and noise, and 2 % of the thrust
MOST = np.iinfo(np.int32).max  # largest count in a compiled program
SMALLEST, LARGEST = float(np.finfo(np.float32).tiny), float(np.finfo(np.float32).max)  # of positive numbers


def is_traced(value: Any) -> bool:
    return isinstance(value, jax.core.Tracer)


def warn(line: str) -> None:
    """Warn at the caller's line, the last one outside of this library."""
    frame, level = sys._getframe(1), 2
    while (above := frame.f_back) and frame.f_globals.get("__name__", "").startswith("hybrid_jax."):
        frame, level = above, level + 1
    warnings.warn(line, stacklevel=level)


def not_traced(name: str, *arguments: Any) -> None:
    """Raise TypeError inside `jax.jit`, `jax.vmap` or `jax.grad`. Functions that branch on values should call this."""
    if any(map(is_traced, jax.tree.leaves(arguments))):
        raise TypeError(
            f"{name} cannot be called under jax.jit, jax.vmap or jax.grad, as it branches on values; "
            "call it outside, or use hybrid_jax.sweep.sweep for many seeds, fields or sets of windows at once"
        )


def real_array(name: str, value: Any) -> Numbers:
    """Convert a value to an array of real numbers; an array is returned unchanged."""
    try:
        array = value if isinstance(value, Numbers) else np.asarray(value)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name} must be an array of real numbers: {first_line(error)}") from error
    numeric = jnp.issubdtype(array.dtype, jnp.floating) or jnp.issubdtype(array.dtype, jnp.integer)
    if not numeric or array.dtype.itemsize > 8:  # JAX has no long double
        raise ValueError(f"{name} must be an array of real numbers, got {type(value).__name__} of {array.dtype}")
    return array


def floating(name: str, value: Any) -> jax.Array:
    """Convert a value to a JAX array of finite floating-point numbers."""
    array = finite(name, real_array(name, value))
    return jnp.asarray(array, None if jnp.issubdtype(array.dtype, jnp.floating) else float)


def finite(name: str, array: Numbers, remedy: str = "", missing: bool = False) -> Numbers:
    """Return the array unchanged; ValueError, with the position, for a number that is not finite in JAX's precision.

    If `missing`, NaN is allowed.
    """
    if is_traced(array):
        return array
    values, precision = np.asarray(array), jnp.result_type(float)
    if values.dtype.itemsize > precision.itemsize:
        with np.errstate(over="ignore"):
            values = values.astype(precision)
    bad = ~np.isfinite(values) & ~(missing & np.isnan(values))
    if bad.any():
        place = np.argwhere(bad)[0].tolist()
        raise ValueError(f"{name}{place or ''} is not finite in {precision}{remedy and '; '}{remedy}")
    return array


def unit_quaternions(name: str, states: Numbers, part: slice) -> None:
    """Require states (..., d) with unit quaternions at `part`."""
    if is_traced(states):
        return
    norms = np.linalg.norm(np.asarray(states)[..., part], axis=-1)
    bad = ~(np.abs(norms - 1) <= UNIT)
    if bad.any():
        place = tuple(np.argwhere(bad)[0].tolist())
        where = ", ".join(map(str, (*place, f"{part.start}:{part.stop}")))
        raise ValueError(f"{name}[{where}] must be a unit quaternion (w, x, y, z), its norm is {norms[place]:.3g}")


def real(value: Any) -> float | None:
    """Convert a real number, or an array without axes, to a float; None for anything else."""
    if isinstance(value, Numbers) and value.ndim == 0 and not is_traced(value):
        value = value.item()
    if isinstance(value, bool) or not isinstance(value, int | float | np.integer | np.floating):
        return None
    too_long = isinstance(value, int | np.integer) and not -MOST <= value <= MOST  # for JAX's integers
    return math.inf if too_long else float(value)


def number(name: str, value: Any, what: str = "a finite number", least: float = -LARGEST) -> None:
    """Require a number that is finite in single precision."""
    found = real(value)
    if not is_traced(value) and (found is None or not least <= found <= LARGEST):
        raise ValueError(f"{name} must be {what}, got {short_repr(value)}")


def positive(name: str, value: Any, what: str = "a positive finite number") -> None:
    number(name, value, what, SMALLEST)


def not_negative(name: str, value: Any) -> None:
    """Require zero or a number that passes `positive`."""
    if real(value) != 0:
        positive(name, value, "a finite number of at least 0")


def count(name: str, value: Any, least: int = 1) -> None:
    if is_traced(value):
        return
    found = value.item() if isinstance(value, Numbers) and value.ndim == 0 else value
    if not isinstance(found, int | np.integer) or isinstance(found, bool) or not least <= found <= MOST:
        raise ValueError(f"{name} must be an integer of at least {least}, got {short_repr(value)}")


def instance(name: str, value: Any, kind: type) -> None:
    if not isinstance(value, kind):
        raise ValueError(f"{name} must be a {kind.__name__}, got {short_repr(value)}")


def list_of(name: str, values: Any, kind: type[T], least: int = 1) -> list[T]:
    """Return the values as a list of instances of `kind`; a single instance outside a list is an error."""
    found = list(values) if isinstance(values, Iterable) else [values]
    if not isinstance(values, Iterable) or not all(isinstance(value, kind) for value in found):
        raise ValueError(f"{name} must be a list of {kind.__name__}, got {short_repr(values)}")
    if len(found) < least:
        raise ValueError(f"{name} must contain at least one {kind.__name__}, but the list is empty")
    return found


def places(name: str, values: Any, size: int = MOST) -> tuple[int, ...]:
    """Return the values as a tuple of at least one index of an axis of length `size`, all different."""
    found = tuple(values) if isinstance(values, Iterable) else ()
    whole = all(isinstance(value, int | np.integer) for value in found)
    if not whole or len({*found}) < max(1, len(found)) or not 0 <= min(found) <= max(found) < size:
        limit = "" if size == MOST else f" and at most {size - 1}"
        raise ValueError(f"{name} must be different integers of at least 0{limit}, got {short_repr(values)}")
    return found


def key(name: str, value: Any) -> None:
    """Require a random key of JAX, typed or raw."""
    if isinstance(value, jax.Array | np.ndarray):
        new = jnp.issubdtype(value.dtype, jax.dtypes.prng_key) and value.ndim == 0
        if new or (value.dtype == np.uint32 and value.shape == (2,)):
            return
    raise ValueError(f"{name} must be a random key, such as jax.random.key(0), got {short_repr(value)}")


def writable_folder(name: str, folder: Path) -> None:
    """Check that a folder can be written, or made, before work begins; it is not made, as the work may fail."""
    try:
        tempfile.TemporaryFile(dir=next(each for each in (folder, *folder.parents) if each.exists())).close()
    except OSError as error:
        raise ValueError(f"{name} {folder}: cannot be written: {error.strerror}") from error


def short_repr(value: Any) -> str:
    return " ".join(repr(value)[:80].split())


def first_line(error: BaseException) -> str:
    """Return the first line of an error's message, shortened in the middle, or the error's class name."""
    line = (str(getattr(error, "strerror", None) or error).strip() or type(error).__name__).splitlines()[0]
    return line if len(line) <= LONGEST else f"{line[: LONGEST // 2]} … {line[-LONGEST // 2 :]}"


def content_of(path: str | Path) -> bytes:
    """Read a regular file; OSError for others, since a pipe or a device may never end."""
    if Path(path).exists() and not Path(path).is_file():
        raise OSError(errno.EINVAL, "is not a regular file")
    return Path(path).read_bytes()
