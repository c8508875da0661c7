"""The parameters of an adapted field, with their confidence intervals."""

from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from hybrid_jax.adaptation.methods import scale_of
from hybrid_jax.adaptation.plausible import THETA, groups_of, values_of
from hybrid_jax.adaptation.pooling import satterthwaite
from hybrid_jax.adaptation.results import Choice, Parameter
from hybrid_jax.adaptation.selection import TINY, correlated
from hybrid_jax.dynamics import disturbance
from hybrid_jax.dynamics.base import AbstractVectorField, trainable
from hybrid_jax.dynamics.disturbance import physics_of
from hybrid_jax.estimation.discretisation import NAMED
from hybrid_jax.estimation.uncertainty import covariance_of, intervals
from hybrid_jax.training.objective import Settings
from hybrid_jax.trajectories import Trajectories

NOT_LEAST_SQUARES = "they are valid for least squares only, where no network is trained on the same windows"
NOT_FINITE = "the fit diverged; check dt and all units"
FEW = "windows: {} are too few to determine {} parameters; undetermined parameters keep the source's values"
BY_NETWORK = "the network's effect is comparable to that of a plausible change; hj.pool of several sources helps"
BY_ROTORS = "the rotors' efficiencies, which were fitted too, can have the same effect"


def size_of(field: AbstractVectorField) -> int:
    """Return the number of parameters of a field's physics."""
    physics = physics_of(disturbance.without_disturbance(field))
    return sum(leaf.size for leaf in jax.tree.leaves(eqx.filter(physics, trainable(physics))))


def parameters_of(
    source: AbstractVectorField,
    field: AbstractVectorField,
    windows: Trajectories,
    settings: Settings,
    level: float,
    without: str | None,
    choice: Choice | None,
) -> dict[str, Any]:
    """Return the attributes of an `Adaptation` that tell of its parameters.

    Args:
        source: the field before.
        field: the adapted field.
        windows: the windows that it was fitted to.
        settings: those of the fit.
        level: confidence level of the intervals.
        without: why there are no intervals, or None.
        choice: the candidates of `Auto`, or None for another method.
    """
    if not 0 < size_of(field) <= NAMED:
        return {"parameters": {}, "without_intervals": NOT_LEAST_SQUARES}
    found = _values(source, field, windows.x0.shape[-1])
    p, places = len(found), []
    free, (kept, vague), absorbed = np.ones(p, bool), np.zeros((2, p), bool), np.zeros(p)
    if choice is not None:
        places = [choice.parameters.index(name) for name in found]
        free = np.asarray(choice.free)[choice.taken][places]
        kept, absorbed, vague = (np.asarray(one)[places] for one in (choice.kept, choice.absorbed, choice.vague))
    if without is None and len(windows) <= free.sum():
        without = FEW.format(len(windows), free.sum())
    if without is not None:
        return {"parameters": found, "without_intervals": without}
    cluster = correlated(windows)
    own_degrees = len(windows) - free.sum() if cluster == 1 else -(-len(windows) // cluster) - 1
    if choice is None:
        scale = scale_of(settings.objective)
        covariance = np.asarray(covariance_of(field, windows, solver=settings.solver, scale=scale, cluster=cluster))
        inherited, of_source = np.zeros_like(covariance), np.inf
    else:
        covariance = choice.covariance(cluster)[np.ix_(places, places)]
        inherited, of_source = np.asarray(choice.inherited)[np.ix_(places, places)], float(choice.degrees)
    # `absorbed` is not estimated from a sample of errors, so its degrees are infinite (GUM, G.4.3).
    parts = np.stack([np.diag(covariance), np.diag(inherited), absorbed])
    degrees = satterthwaite(parts, np.array([own_degrees, of_source, np.inf]))
    of_change = satterthwaite(parts[:2], np.array([own_degrees, of_source]))  # the source has the same network
    covariance = covariance + inherited
    if np.isnan(covariance).any():
        return {"parameters": found, "without_intervals": NOT_FINITE}
    whole = covariance + np.diag(absorbed)
    bounds = intervals(field, jnp.asarray(whole), level, degrees)
    apart = intervals(field, jnp.asarray(covariance), level, of_change)
    groups = groups_of([*found])
    scaled, moved = "efficiency" in np.array(groups)[free], dict[str, float]()
    for i, (name, one) in enumerate(found.items()):
        if not (free[i] or kept[i]):
            continue
        _, low, high = jax.device_get(tuple(bounds[name]))
        _, *ends = jax.device_get(tuple(apart[name]))
        least, most = (float(end - one.before) for end in ends)
        if free[i] and not least <= 0 <= most:
            moved[name] = float(abs(one.value - one.before) / max(most - least, TINY))
        reason = BY_NETWORK if vague[i] else BY_ROTORS if scaled and groups[i] in THETA else None
        bound = {"effective": reason} if reason else {"low": float(low), "high": float(high)}
        change = {} if reason == BY_ROTORS else {"change": (least, most)}
        found[name] = replace(one, **bound, **change)
    changed = tuple(sorted(moved, key=lambda name: -moved[name]))
    numbers = {"covariance": whole, "degrees": degrees, "absorbed": absorbed, "changed": changed}
    return {"parameters": found, "without_intervals": None} | numbers


def _values(source: AbstractVectorField, field: AbstractVectorField, d: int) -> dict[str, Parameter]:
    """Return the parameters by name, with their units and the source's values, but no intervals."""
    own, values, before = physics_of(disturbance.without_disturbance(field)), values_of(field), values_of(source, d)
    known = (own.parameter_units if isinstance(own, AbstractVectorField) else {}) | disturbance.disturbance_units(field)
    units = {name: known.get(name, known.get(name.split("[")[0])) or None for name in values}
    return {name: Parameter(one, unit=units[name], before=before.get(name, np.nan)) for name, one in values.items()}
