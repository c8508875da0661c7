"""Save and load trained models. A file contains only data, so loading it cannot run code."""

import contextlib
import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from functools import reduce
from pathlib import Path
from typing import Any, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hybrid_jax import checks
from hybrid_jax.dynamics.base import AbstractVectorField, state_space
from hybrid_jax.integrate import checked, rollout, rollout_batch
from hybrid_jax.io.files import Arrays, load_archive, named_leaves, save_archive, to_numpy, with_leaves
from hybrid_jax.io.structure import Structure, decode, static_values
from hybrid_jax.networks.normalisation import AbstractScaling
from hybrid_jax.runtime import entry

FORMAT = "hybrid_jax model 2"


@dataclass(frozen=True)
class Model:
    """A saved model: a vector field and its metadata.

    Attributes:
        field: the vector field ẋ = f(x, u), or any other Equinox module that was saved.
        about: JSON values about it, for example its origin and test error.
    """

    field: AbstractVectorField
    about: Mapping[str, Any] = dataclasses.field(default_factory=dict)

    @entry
    def predict(
        self, x0: Float[Array | np.ndarray, "*n d"], u: Float[Array | np.ndarray, "*n t m"], dt: float
    ) -> Float[Array, "*n t d"]:
        """Predict the state at the end of each interval, for one window or for n, under piecewise constant inputs.

        If some windows may diverge and you need the others, you should use `rollout_batch` instead.

        Args:
            x0: the initial state of each window.
            u: the input in each of the t intervals of each window.
            dt: length of an interval [s].

        Raises:
            ValueError: if shapes do not agree or do not fit the model, a number is not finite, dt is not positive, an
                initial quaternion is not of norm 1, or a prediction diverges.
        """
        if not callable(self.field):
            name = type(self.field).__name__
            raise ValueError(f"the model is a {name}, which needs more than x0 and u; use the methods of its `field`")
        x0, u = (checks.floating(name, value).astype(float) for name, value in (("x0", x0), ("u", u)))
        checked(self.field, x0, u, dt, None, windows=x0.ndim == 2)
        state_space(self.field, x0.shape[-1]).check("x0", x0)
        predicted = (rollout if x0.ndim == 1 else rollout_batch)(self.field, x0, u, dt)
        diverged = ~np.isfinite(predicted).all(axis=-1)
        if diverged.any():
            *window, interval = np.argwhere(diverged)[0].tolist()
            where = f" of window {window[0]}, the first of {diverged.any(axis=-1).sum()}," if window else ""
            raise ValueError(f"the prediction{where} diverges: it is not finite from interval {interval} on")
        return predicted


def save(path: str | Path, field: eqx.Module, about: Mapping[str, Any] | None = None) -> None:
    """Save a model, any Equinox module, to one file, with JSON values `about` it.

    You get a warning if `load` will need `like`, because the file is not enough to rebuild the model, or if other
    programs will need it, because a class is defined in the script that runs.

    Args:
        path: the file to write; an existing file is replaced.
        field: the model. You should define its classes in a module that you can import.
        about: JSON values, which `load` returns with the field.

    Raises:
        ValueError: if `about` is not JSON, or the field contains an object other than an array, number, text, function,
            container or module.
        OSError: if the file cannot be written.
    """
    about = {} if about is None else about
    checks.instance("about", about, Mapping)
    structure = Structure(field)
    arrays = named_leaves({"field": field}) | {key: to_numpy(leaf) for key, leaf in structure.static_arrays.items()}
    save_archive(path, FORMAT, {"field": structure.tree, "about": dict(about)}, arrays)
    if structure.of_script:
        where = "define it in a module, which other programs can import, or let them pass like="
        checks.warn(f"{path}: class {structure.of_script} is of the script that runs; {where}")
    if structure.problem is not None:
        checks.warn(f"{path}: this model can only be loaded with like=: {structure.problem}")
    if spoiled := _not_finite(field):
        checks.warn(f"{path}: this model cannot be loaded: {spoiled}")


def load(path: str | Path, like: eqx.Module | None = None) -> Model:
    """Read a model that `save` wrote. You should import the modules that define its classes first.

    Args:
        path: the file to read.
        like: a field of the same structure, whose arrays and scalings are replaced by those in the file. You need it
            for classes and functions that the file cannot name, for example local classes and lambdas.

    Raises:
        ValueError: if the file is missing, damaged or not a model, a class or function is unknown, an array is not
            finite or not of the type and shape that its class declares, or the file does not fit `like`.
    """
    metadata, arrays = load_archive(path, FORMAT)
    try:
        about, tree = dict(metadata["about"]), metadata["field"]
        field = decode(tree, arrays) if like is None else _filled(like, tree, arrays)
        if not isinstance(field, eqx.Module):
            raise TypeError(f"the saved object is a {type(field).__name__}")
        if spoiled := _not_finite(field):
            raise ValueError(spoiled)
    except (KeyError, TypeError, AttributeError, RecursionError, OverflowError) as error:
        raise ValueError(f"{path}: not a complete model: {checks.first_line(error)}") from error
    except ValueError as error:
        raise ValueError(f"{path}: {checks.first_line(error)}") from error
    return Model(cast(AbstractVectorField, field), about)


def _not_finite(field: eqx.Module) -> str:
    """Describe an array that is not finite, for example after a fit that diverged; "" if all are."""
    for keys, leaf in jax.tree_util.tree_leaves_with_path(eqx.filter(field, eqx.is_inexact_array)):
        path = jax.tree_util.keystr(keys, simple=True, separator="/")
        unmeasured = np.isnan(leaf) & path.endswith("learned_from/x")
        if bad := int((~np.isfinite(leaf) & ~unmeasured).sum()):
            return f"array field/{path} must be finite, {bad} of its {leaf.size} numbers are not"
    return ""


def _filled(like: eqx.Module, tree: Any, arrays: Arrays) -> Any:
    dynamic = {key: array for key, array in arrays.items() if not key.startswith("static/")}
    like, saved = _with_scalings(like, tree, arrays), static_values(tree)
    filled = with_leaves({"field": like}, dynamic)["field"]
    for key, value in static_values(Structure(like).tree).items():
        if saved.get(key, value) != value:
            raise ValueError(f"{key} is {saved[key]!r}, but {value!r} in `like`")
    return jax.tree.map(lambda leaf: jnp.asarray(leaf) if isinstance(leaf, np.ndarray) else leaf, filled)


def _with_scalings(like: eqx.Module, tree: Any, arrays: Arrays) -> Any:
    """Return `like` with the scalings in the file: `fit` sets them, so a new field has none."""
    parts, structure = jax.tree_util.tree_flatten_with_path(like, is_leaf=_is_scaling)
    leaves = []
    for path, leaf in parts:
        if _is_scaling(leaf):
            with contextlib.suppress(KeyError, IndexError, TypeError):  # of another structure, which is said later
                leaf = decode(reduce(_part, path, tree), arrays)
        leaves.append(leaf)
    return jax.tree.unflatten(structure, leaves)


def _is_scaling(part: Any) -> bool:
    return isinstance(part, AbstractScaling)


def _part(node: Any, key: Any) -> Any:
    match node:
        case {"fields": parts}:
            return parts[key.name]
        case {"items": pairs}:
            return dict(pairs)[key.key]
        case {"tuple": parts} | {"list": parts}:
            return parts[key.idx]
    raise KeyError(key)


def check_savable(field: Any) -> str | None:
    """Return why `load` cannot rebuild this field from its file without `like`, or None if it can.

    Args:
        field: the model to save.
    """
    try:
        return Structure(field).problem
    except ValueError as error:
        return str(error)
