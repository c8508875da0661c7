"""What a user might pass to a public function in the place of what it asks for, and what may come of it."""

import os
import warnings
from fractions import Fraction
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st

TOTAL = {"full": 10_000}.get(os.environ.get("CASES", ""), 200)


def cases(share):
    """This share of all cases, drawn the same way every time."""
    ignored = [HealthCheck.too_slow, HealthCheck.data_too_large, HealthCheck.filter_too_much]
    same = {"derandomize": True, "deadline": None, "database": None, "suppress_health_check": ignored}
    return settings(max_examples=max(round(share * TOTAL), 5), **same)


def outcome(function, *arguments, naming="", **named):
    """What a call returns, or None if it was refused: by a ValueError of one line that begins with `naming`."""
    try:
        with warnings.catch_warnings(action="ignore"):
            return function(*arguments, **named)
    except ValueError as error:
        said = str(error)
    assert said.startswith(naming)
    assert said
    assert "\n" not in said
    return None


def refusal(call, *words):
    """The one line, from ^ to $, in which a call is refused with a ValueError; it holds all these words."""
    with pytest.raises(ValueError, match=r".") as error:
        call()
    message = str(error.value)
    assert "\n" not in message
    for word in words:
        assert str(word) in f"^{message}$", message
    return message


def is_finite(tree):
    return all(np.isfinite(np.asarray(leaf)).all() for leaf in jax.tree.leaves(eqx.filter(tree, eqx.is_array)))


def with_number(number, array, place):
    spoiled = np.array(array, float)
    if spoiled.size:
        spoiled.flat[place % spoiled.size] = number
    return spoiled


def with_quaternion(size, array, _):
    spoiled = np.array(array)
    spoiled[..., 3:7] *= size
    return spoiled


# Name → what becomes of a sound array.
SPOILED = {
    "itself": lambda array, _: array,
    "jax": lambda array, _: jnp.asarray(array),
    "list": lambda array, _: array.tolist(),
    **{
        kind: lambda array, _, kind=kind: array.astype(kind)
        for kind in ("f8", "f2", "g", "i4", "u1", "?", "c8", "O", "U9", "S9", "M8[s]")
    },
    **{str(number): partial(with_number, number) for number in (np.nan, np.inf, -np.inf, 1e300, 1e25, -1e5)},
    "masked": lambda array, place: np.ma.masked_invalid(with_number(np.nan, array, place)),
    "no rotation": partial(with_quaternion, 0.0),
    "long rotation": partial(with_quaternion, 1.3),
    "short": lambda array, _: array[:-1],
    "narrow": lambda array, _: array[..., :-1],
    "wide": lambda array, _: np.concatenate([array, array[..., :1]], axis=-1),
    "none": lambda array, _: array[:0],
    "flat": lambda array, _: array[..., :0],
    "deep": lambda array, _: array[None],
    "shallow": lambda array, _: array[0],
    "ragged": lambda array, _: [[1.0], [1.0, 2.0]],
    "number": lambda array, _: 3.0,
    "nothing": lambda array, _: None,
    "text": lambda array, _: "x0",
    "dictionary": lambda array, _: {"x0": array},
}


@st.composite
def spoiled(draw, array, harm=0.5):
    """The array, or with the given chance what a user might pass in its place."""
    if draw(st.floats(0, 1)) > harm:
        return array
    return SPOILED[draw(st.sampled_from(sorted(SPOILED)))](array, draw(st.integers(0, 1000)))


def odd(*sound):
    """A sound number most of the time, or what a user might pass in its place."""
    wrong = (0, -1, -0.5, 0.0, np.nan, np.inf, -np.inf, 1e300, 1e-320, 10**400, 2**31, 2.5, True, None, "1", 1j)
    objects = (Fraction(1, 2), np.float64(-1), np.array(np.nan), np.ones(2), jnp.zeros(()), [1], {}, b"1")
    return st.one_of(*[st.sampled_from(sound)] * 2, st.sampled_from((*wrong, *objects, np.longdouble(-1))))
