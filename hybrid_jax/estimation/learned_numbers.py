"""Names of the numbers that a model of records learns, and what is known of them before a fit."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from hybrid_jax.dynamics.base import AbstractVectorField, ravel_learned, trainable
from hybrid_jax.dynamics.disturbance import physics_of
from hybrid_jax.estimation.shooting import Model
from hybrid_jax.estimation.uncertainty import names_of

LOGARITHM = 3.0  # largest step of a logarithm: the linear model would take one that loses its effect to −∞


def places_of(model: Model, part: Callable[[Model], Any]) -> Int[np.ndarray, " k"]:
    """Return where the learned numbers of a part of the model are among all, in the order of `ravel_learned`."""
    theta, unravel = ravel_learned(model)
    return np.asarray(ravel_learned(part(unravel(jnp.arange(len(theta), dtype=theta.dtype))))[0]).astype(int)


def physics_in(model: Model) -> AbstractVectorField:
    return physics_of(model.field)


def learned_names(model: Model) -> list[str]:
    """Return the name of each learned number, in the order of `ravel_learned`, for example log_drag or gyro.bias.

    Physics' numbers are named as in `uncertainty.named_parameters`, and others by their path in the field or outputs.
    """
    leaves = jax.tree_util.tree_leaves_with_path(eqx.filter(model, trainable(model)))
    paths = ((jax.tree_util.keystr(path, simple=True, separator="."), leaf.shape) for path, leaf in leaves)
    indices = ((path.split(".", 1)[1], at) for path, shape in paths for at in np.ndindex(shape))
    names = [f"{path}[{','.join(map(str, at))}]" if at else path for path, at in indices]
    for place, name in zip(places_of(model, physics_in), names_of(model.field), strict=True):
        names[place] = name
    return names


def logarithms(names: Sequence[str]) -> Bool[np.ndarray, " p"]:
    return np.array([name.split(".")[-1].startswith("log_") for name in names], bool)


def deviations_of(model: Model, prior: Mapping[str, float]) -> Float[np.ndarray, " p"]:
    """Return the prior deviation of each learned number; ValueError for an unknown name."""
    names, used = learned_names(model), set()
    found = np.full(len(names), np.inf)
    for i, name in enumerate(names):
        chosen = [each for each in prior if name == each or name.startswith((f"{each}.", f"{each}["))]
        used.update(chosen)
        found[i] = prior[max(chosen, key=len)] if chosen else np.inf
    for name in prior.keys() - used:
        known = dict.fromkeys(each.split("[")[0] for each in names)
        raise ValueError(f"prior: the model has no {name}; it has {', '.join(known)}")
    return found


def largest_steps(model: Model) -> Float[np.ndarray, " p"]:
    """Return by how much one step of a search may change each learned number."""
    return np.where(logarithms(learned_names(model)), LOGARITHM, np.inf)
