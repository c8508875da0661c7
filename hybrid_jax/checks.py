"""What public functions ask of their arguments: a check names the argument as the user wrote it, in one line.

Raise outside, carry inside: in a compiled or mapped program an array has a shape and a type but no numbers yet (it is
traced), so there no number is looked at, and what comes of bad ones is carried.
"""

import math
from typing import Any

import jax
import jax.core
import jax.numpy as jnp
import numpy as np

from hybrid_jax.state import QUATERNION

Numbers = jax.Array | np.ndarray

UNIT = 1e-2  # |q| may be off 1 by this: rounding and noise are far below, and it is 2 % of the thrust
MOST = np.iinfo(np.int32).max  # what a count may be in a compiled program
SMALLEST, LARGEST = float(np.finfo(np.float32).tiny), float(np.finfo(np.float32).max)  # of what is not zero there


def is_traced(value: Any) -> bool:
    """Whether the numbers of a value are not known yet."""
    return isinstance(value, jax.core.Tracer)


def real_array(name: str, value: Any) -> Numbers:
    """The value as an array of real numbers; what is an array stays as it is.

    Raises:
        ValueError: it is none, for example text, objects, complex numbers or lists of unequal lengths.
    """
    try:
        array = value if isinstance(value, Numbers) else np.asarray(value)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name} must be an array of real numbers: {first_line(error)}") from error
    numeric = jnp.issubdtype(array.dtype, jnp.floating) or jnp.issubdtype(array.dtype, jnp.integer)
    if not numeric or array.dtype.itemsize > 8:  # JAX has no long double
        raise ValueError(f"{name} must be an array of real numbers, got {type(value).__name__} of {array.dtype}")
    return array


def floating(name: str, value: Any) -> jax.Array:
    """The value as a JAX array of floating-point numbers, all finite as far as they are known.

    Raises:
        ValueError: no array of real numbers, or the first one that is not finite in JAX's precision.
    """
    array = finite(name, real_array(name, value))
    return jnp.asarray(array, None if jnp.issubdtype(array.dtype, jnp.floating) else float)


def finite(name: str, array: Numbers) -> Numbers:
    """The array unchanged.

    Raises:
        ValueError: the place of the first number that is not finite, or too large for JAX's precision.
    """
    if is_traced(array):
        return array
    values, precision = np.asarray(array), jnp.result_type(float)
    if values.dtype.itemsize > precision.itemsize:
        with np.errstate(over="ignore"):
            values = values.astype(precision)
    bad = ~np.isfinite(values)
    if bad.any():
        place = np.argwhere(bad)[0].tolist()
        raise ValueError(f"{name}{place or ''} is not finite in {precision}")
    return array


def unit_quaternions(name: str, states: Numbers) -> None:
    """Refuse states (..., 13) whose quaternion is none of a rotation.

    Raises:
        ValueError: the place of the first and its norm.
    """
    if is_traced(states):
        return
    norms = np.linalg.norm(np.asarray(states)[..., QUATERNION], axis=-1)
    bad = ~(np.abs(norms - 1) <= UNIT)
    if bad.any():
        place = tuple(np.argwhere(bad)[0].tolist())
        where = ", ".join(map(str, (*place, f"{QUATERNION.start}:{QUATERNION.stop}")))
        raise ValueError(f"{name}[{where}] must be a unit quaternion (w, x, y, z), its norm is {norms[place]:.3g}")


def real(value: Any) -> float | None:
    """The number that a real number, or an array of one without axes, holds; None for anything else."""
    if isinstance(value, Numbers) and value.ndim == 0 and not is_traced(value):
        value = value.item()
    if isinstance(value, bool) or not isinstance(value, int | float | np.integer | np.floating):
        return None
    too_long = isinstance(value, int | np.integer) and not -MOST <= value <= MOST  # for JAX's integers
    return math.inf if too_long else float(value)


def number(name: str, value: Any) -> None:
    """Refuse what is no number that is finite in single precision.

    Raises:
        ValueError: the name, what was expected and the value.
    """
    found = real(value)
    if not is_traced(value) and (found is None or not abs(found) <= LARGEST):
        raise ValueError(f"{name} must be a finite number, got {short_repr(value)}")


def positive(name: str, value: Any, what: str = "a positive finite number") -> None:
    """Refuse what is no positive finite number in single precision.

    Raises:
        ValueError: the name, what was expected and the value.
    """
    found = real(value)
    if not is_traced(value) and (found is None or not SMALLEST <= found <= LARGEST):
        raise ValueError(f"{name} must be {what}, got {short_repr(value)}")


def not_negative(name: str, value: Any) -> None:
    """Refuse what is neither zero nor as `positive` wants it.

    Raises:
        ValueError: as `positive`.
    """
    if real(value) != 0:
        positive(name, value, "a finite number of at least 0")


def count(name: str, value: Any, least: int = 1) -> None:
    """Refuse what is no integer of at least `least`.

    Raises:
        ValueError: the name, what was expected and the value.
    """
    if is_traced(value):
        return
    found = value.item() if isinstance(value, Numbers) and value.ndim == 0 else value
    if not isinstance(found, int | np.integer) or isinstance(found, bool) or not least <= found <= MOST:
        raise ValueError(f"{name} must be an integer of at least {least}, got {short_repr(value)}")


def key(name: str, value: Any) -> None:
    """Refuse what is no random key of JAX, of the new kind or the old.

    Raises:
        ValueError: the name and how to make one.
    """
    if isinstance(value, jax.Array | np.ndarray):
        new = jnp.issubdtype(value.dtype, jax.dtypes.prng_key) and value.ndim == 0
        if new or (value.dtype == np.uint32 and value.shape == (2,)):
            return
    raise ValueError(f"{name} must be a random key, such as jax.random.key(0), got {short_repr(value)}")


def short_repr(value: Any) -> str:
    """The beginning of a value's own description, in one line."""
    return " ".join(repr(value)[:80].split())


def first_line(error: BaseException) -> str:
    """The first line of what an error says, or the name of its kind."""
    return (str(error).strip() or type(error).__name__).splitlines()[0]
