"""Prepare a field for export: a function of x and u in one precision, and its sizes."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from hybrid_jax import checks
from hybrid_jax.dynamics.base import AbstractVectorField, as_field, parts_of
from hybrid_jax.dynamics.hidden import DisturbanceModel, WithHidden
from hybrid_jax.integrate import check_field, rk4_step
from hybrid_jax.networks import smoothed
from hybrid_jax.vehicle import STATE_SIZE, Vehicle

OBSERVED = "x", "u", "measured"  # arguments of a program with `observe`
Size = int | None  # d or m; by default from the field


def program_of(
    field: AbstractVectorField,
    likes: Sequence[jax.ShapeDtypeStruct],
    dt: float | None,
    smooth: float | None,
    batched: bool = False,
) -> Callable[..., Array]:
    """Return ẋ = f(x, u), or the step of RK4 over dt [s], with the field's numbers in the precision of `likes`.

    `likes` are one x and one u; if `batched`, the function takes rows of them. With a third, `measured`, it returns the
    state of a field with a past after this sample. ValueError if they do not match the field.
    """
    field = prepared(field, likes[:2], smooth)
    if len(likes) > 2:
        after = partial(observed, field, dt)
        return jax.vmap(after) if batched else lambda *given: after(*given)

    def of_rows(x, u):
        return jnp.moveaxis(as_field(field).infer_batch(jnp.moveaxis(x, 0, -1), jnp.moveaxis(u, 0, -1)), -1, 0)

    derivative = of_rows if batched else field
    whole = derivative if dt is None else partial(rk4_step, derivative, dt=dt)
    return lambda x, u: whole(x, u)  # jax.jit needs a hashable function


def observed(model: Any, dt: Any, x, u, measured) -> Float[Array, " d+f"]:
    """Return the state after a sample that was measured dt [s] after x, with u held in between."""
    return model.after(x, rk4_step(model.field, x[: len(measured)], u, dt), measured, dt)


def prepared(
    field: AbstractVectorField, likes: Sequence[jax.ShapeDtypeStruct], smooth: float | None
) -> AbstractVectorField:
    """Convert the field to the precision of x and u, perhaps with `SmoothRelu`; ValueError if they do not match it."""
    precision = likes[0].dtype
    field = jax.tree.map(lambda leaf: jnp.asarray(leaf, precision) if eqx.is_inexact_array(leaf) else leaf, field)
    if smooth is not None:
        checks.positive("smooth", smooth)
        field = smoothed(field, smooth)
    check_field(field, *likes)
    return field


def sizes_of(field: Any, state_size: Size, input_size: Size, observe: bool = False) -> tuple[int, ...]:
    """Return the given sizes, or the sizes that the field or a part of it has as attributes; else ValueError.

    If `observe`, the third is the number of states that are measured.
    """
    known = _known_sizes(field) or (None, None)
    d, m = state_size if state_size is not None else known[0], input_size if input_size is not None else known[1]
    for name, size, least in (("state_size", d, 1), ("input_size", m, 0)):
        if size is None:
            raise ValueError(f"{name} must be given: {type(field).__name__} does not know its size")
        checks.count(name, size, least)
    if observe and not isinstance(field, DisturbanceModel):
        raise ValueError(f"observe: needs a field that `fit_disturbance` returned, got {type(field).__name__}")
    return (d, m, d - field.hidden) if observe else (d, m)  # pyright: ignore[reportReturnType, reportOptionalOperand]


def _known_sizes(tree: Any) -> tuple[int, int] | None:
    if isinstance(tree, DisturbanceModel | WithHidden):
        inside = _known_sizes(tree.field)
        return inside and (inside[0] + tree.hidden, inside[1])
    for part in parts_of(tree):
        if isinstance(vehicle := getattr(part, "vehicle", None), Vehicle):
            return STATE_SIZE, vehicle.rotors
        if isinstance(part, eqx.Module) and hasattr(part, "state_size") and hasattr(part, "input_size"):
            return part.state_size, part.input_size  # pyright: ignore[reportAttributeAccessIssue]
    return None
