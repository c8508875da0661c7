"""Trained models as files: saved, loaded with one call, used for prediction. Loading runs no code from the file."""

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hybrid_jax import checks
from hybrid_jax.dynamics.base import AbstractVectorField, Frozen, Hybrid, RunningStats
from hybrid_jax.dynamics.baselines import FrozenRates, HoldState
from hybrid_jax.dynamics.disturbance import ConstantDisturbance
from hybrid_jax.dynamics.multirotor import Multirotor
from hybrid_jax.dynamics.rigid_body import ForcedBody, RigidBody, check_start
from hybrid_jax.dynamics.terms import Terms
from hybrid_jax.integrate import checked, rollout, rollout_batch
from hybrid_jax.io.archive import load_archive, save_archive
from hybrid_jax.networks.mlp import FusedNetwork, LinearResidual, LinearSkip, ResidualNetwork
from hybrid_jax.networks.normalisation import BatchNorm, Bias, LayerNorm
from hybrid_jax.networks.rotor_thrust import RotorThrust
from hybrid_jax.networks.scaling import ChannelScaling, InputScaling
from hybrid_jax.networks.views import Accelerations, BodyFrame, BodyMotion, DropXY, DropXYYaw, GroundDistance, Motion
from hybrid_jax.vehicle import Vehicle

FORMAT = "hybrid_jax model 1"
_KINDS: dict[str, type] = {}
Kind = TypeVar("Kind", bound=type)


def portable(kind: Kind) -> Kind:
    """Let a module class be saved and loaded under its name; use it as a decorator on a field of one's own.

    The class must be made from its fields: numbers, text, arrays, tuples, dictionaries and other portable classes.
    """
    _KINDS[kind.__name__] = kind
    return kind


_FIELDS = (
    *(ConstantDisturbance, FusedNetwork, ForcedBody, Frozen, FrozenRates, HoldState, Hybrid),
    *(LinearSkip, LinearResidual, Multirotor, ResidualNetwork, RigidBody, RotorThrust),
)
_VIEWS = (Accelerations, BodyFrame, BodyMotion, Motion, GroundDistance, DropXY, DropXYYaw)
_PARTS = (BatchNorm, Bias, ChannelScaling, InputScaling, LayerNorm, RunningStats, Terms, Vehicle)
for _kind in _FIELDS + _VIEWS + _PARTS:
    portable(_kind)


@dataclass(frozen=True)
class Model:
    """A vector field that has left the lab, with what is known about it.

    Attributes:
        field: the vector field ẋ = f(x, u).
        about: JSON values: where it comes from, how well it did.
    """

    field: AbstractVectorField
    about: Mapping[str, Any] = dataclasses.field(default_factory=dict)

    def predict(
        self, x0: Float[Array | np.ndarray, "*n d"], u: Float[Array | np.ndarray, "*n t m"], dt: float
    ) -> Float[Array, "*n t d"]:
        """The states after each of t intervals of dt [s] with the inputs held over them; one window or n.

        What is returned is finite: a prediction that diverges is of no use to a caller, who might not look. Where the
        other windows are wanted all the same, `rollout_batch` carries on.

        Raises:
            ValueError: shapes that do not agree, a number that is not finite, dt that is not positive, a start of a
                rigid body without a unit quaternion, a model that is no vector field or not of such states and inputs,
                or a prediction that diverges; says in which window and from which interval on.
        """
        if not callable(self.field):
            name = type(self.field).__name__
            raise ValueError(f"the model is a {name}, which needs more than x0 and u; use the methods of its `field`")
        x0, u = (checks.floating(name, value).astype(float) for name, value in (("x0", x0), ("u", u)))
        checked(self.field, x0, u, dt, None, windows=x0.ndim == 2)
        check_start(self.field, x0)
        predicted = _predict(self.field, x0, u, dt)
        lost = ~np.isfinite(predicted).all(axis=-1)
        if lost.any():
            *window, interval = np.argwhere(lost)[0].tolist()
            where = f" of window {window[0]}, the first of {lost.any(axis=-1).sum()}," if window else ""
            raise ValueError(f"the prediction{where} diverges: it is not finite from interval {interval} on")
        return predicted


@eqx.filter_jit
def _predict(field, x0, u, dt):
    return rollout(field, x0, u, dt) if x0.ndim == 1 else rollout_batch(field, x0, u, dt)


def save(path: str | Path, field: AbstractVectorField, about: Mapping[str, Any] | None = None) -> None:
    """Write a field and what is known about it to one file.

    Raises:
        ValueError: the field holds something that is not portable; says what and how to mend it.
        OSError: the folder cannot be written.
    """
    arrays: dict[str, np.ndarray] = {}
    save_archive(path, FORMAT, {"field": _encode(field, "field", arrays), "about": dict(about or {})}, arrays)


def load(path: str | Path) -> Model:
    """Read a model that `save` wrote.

    Raises:
        ValueError: the file is missing, damaged, no model, or of a class that this program has not made portable.
    """
    metadata, arrays = load_archive(path, FORMAT)
    try:
        field: Any = _decode(metadata["field"], arrays)
        about = dict(metadata["about"])
    except (KeyError, TypeError, AttributeError, RecursionError) as error:
        raise ValueError(f"{path}: not a whole model: {checks.first_line(error)}") from error
    except ValueError as error:
        raise ValueError(f"{path}: {checks.first_line(error)}") from error
    if type(field).__name__ not in _KINDS:
        raise ValueError(f"{path}: not a whole model: its field is a {type(field).__name__}")
    return Model(field, about)


def check_savable(field: AbstractVectorField) -> str | None:
    """Why a file of this field could not be loaded; None if it can be."""
    try:
        describe(field)
    except ValueError as error:
        return str(error)
    return None


def describe(field: AbstractVectorField) -> Any:
    """What a field is apart from its arrays, as JSON values: classes, the vehicle, scalings, names of parameters.

    Raises:
        ValueError: as `save`.
    """
    return _encode(field, "field", {})


def _encode(value: Any, path: str, arrays: dict[str, np.ndarray]) -> Any:
    name = type(value).__name__
    if _KINDS.get(name) is type(value):
        parts = {f.name: _encode(getattr(value, f.name), f"{path}/{f.name}", arrays) for f in fields(value)}
        return {"kind": name, "fields": parts}
    match value:
        case jax.Array() | np.ndarray() if not jnp.issubdtype(value.dtype, jax.dtypes.extended):
            if path in arrays:
                raise ValueError(f"two arrays would be {path}; let no key of a dictionary hold a '/'")
            arrays[path] = np.asarray(value)
            return {"array": path}
        case dict() if all(isinstance(key, str) for key in value):
            return {"items": {key: _encode(item, f"{path}/{key}", arrays) for key, item in value.items()}}
        case tuple():
            return {"tuple": [_encode(item, f"{path}/{i}", arrays) for i, item in enumerate(value)]}
        case None | bool() | int() | float() | str():
            return value
    raise ValueError(f"{path} is a {name}, which cannot be saved; decorate its class with hybrid_jax.portable")


def _decode(value: Any, arrays: Mapping[str, np.ndarray]) -> Any:
    match value:
        case {"kind": str() as name, "fields": dict() as parts}:
            if name not in _KINDS:
                raise ValueError(f"a model of class {name!r}, which no class here made portable")
            return _KINDS[name](**{key: _decode(part, arrays) for key, part in parts.items()})
        case {"array": str() as path}:
            return jnp.asarray(arrays[path])
        case {"items": dict() as items}:
            return {key: _decode(item, arrays) for key, item in items.items()}
        case {"tuple": list() as items}:
            return tuple(_decode(item, arrays) for item in items)
    return value
