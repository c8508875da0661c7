"""Before a training run begins: can this field be trained on these windows, in minibatches of this size?"""

import jax
import jax.numpy as jnp
from jaxtyping import PRNGKeyArray, PyTree

from hybrid_jax import checks
from hybrid_jax.dynamics.base import AbstractVectorField, Frozen, trainable
from hybrid_jax.dynamics.rigid_body import moves_a_rigid_body
from hybrid_jax.integrate import checked
from hybrid_jax.networks.normalisation import BatchNorm
from hybrid_jax.training.objective import Learner, Settings
from hybrid_jax.trajectories import Trajectories, check_attitudes


def prepared(
    field: Learner, train: Trajectories, validation: Trajectories, key: PRNGKeyArray, settings: Settings
) -> tuple[PyTree, PyTree]:
    """Both sets of windows as the objective prepares them, if the field can be trained on them with this key.

    Raises:
        ValueError: windows that the objective refuses, that are not of the field's states and inputs, or are of a rigid
            body and have no unit quaternions; fewer of them than a minibatch, or a minibatch that `check_minibatch`
            refuses; a field with nothing to learn; or no random key.
    """
    data = settings.objective.prepare(train, "train")
    judged_on = settings.objective.prepare(validation, "validation")
    _check_learns(field)
    for name, windows in (("train", train), ("validation", validation)):
        _check_match(field, windows, name, settings)
    checks.key("key", key)
    checks.count("settings.batch_size", settings.batch_size)
    check_minibatch(field, settings)
    if len(data) < settings.batch_size:
        raise ValueError(f"train has {len(data)} windows, fewer than batch_size={settings.batch_size}")
    return data, judged_on


def check_minibatch(field: Learner, settings: Settings) -> None:
    """Refuse minibatches of one window where the minibatch normalises: less its own mean, a window is a constant.

    Raises:
        ValueError: the field learns through a BatchNorm, and the minibatch is smaller than 2.
    """
    nodes = jax.tree.leaves(field, is_leaf=lambda node: isinstance(node, Frozen | BatchNorm))
    if settings.batch_size < 2 and any(isinstance(node, BatchNorm) for node in nodes):
        raise ValueError(
            f"settings.batch_size must be at least 2 where the field holds a BatchNorm, got {settings.batch_size}"
        )


def _check_learns(field: Learner) -> None:
    if isinstance(field, AbstractVectorField) and not any(jax.tree.leaves(trainable(field))):
        raise ValueError(
            f"field: {type(field).__name__} has nothing to learn, no array of floating-point numbers; a Python float "
            "is none, use jnp.asarray"
        )


def _check_match(field: Learner, windows: Trajectories, name: str, settings: Settings) -> None:
    """Refuse windows that are not of the field: a learner that is no vector field is the objective's business."""
    if isinstance(field, AbstractVectorField):
        try:
            x0, _, _ = checked(field, windows.x0, windows.u, windows.dt, settings.solver, windows=True)
        except ValueError as error:
            raise ValueError(f"{name}: {error}") from error
        if x0.dtype != jnp.result_type(windows.x0):
            raise ValueError(f"{name}: x0 must be {x0.dtype}, the precision of the field, got {windows.x0.dtype}")
    if moves_a_rigid_body(field):
        check_attitudes(windows, name)
