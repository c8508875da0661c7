"""Adaptation by a method of `hybrid_jax.adaptation`, for every size and seed."""

from collections.abc import Mapping
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from experiments.paper.conditions import sampled_indices, settings
from experiments.paper.config import Config
from experiments.reporting import names
from experiments.runner.stages import Stages
from hybrid_jax.adaptation import METHODS, LeastSquares, Method
from hybrid_jax.dynamics.base import AbstractVectorField
from hybrid_jax.io.datasets import Dataset
from hybrid_jax.metrics import rollout_mse
from hybrid_jax.runtime import FAST_COMPILE
from hybrid_jax.sweep.lanes import stack
from hybrid_jax.training.objective import Settings
from hybrid_jax.trajectories import Trajectories

# The models that are not trained: a method of the library adapts the hybrid.
SOLVED: Mapping[str, Method] = {
    names.LAST_LAYER: METHODS["last_layer"],
    names.LEAST_SQUARES: METHODS["theta_least_squares"],
    names.CONSTANT_DISTURBANCE: LeastSquares(disturbance=True),
    names.LINEAR_RESIDUAL: METHODS["linear_residual"],
}


class Solved(NamedTuple):
    """Adapted models, stacked, one for each size and seed in the order of `study.places`."""

    fields: Any
    val_mse: Any  # L_MSE of each on the validation windows
    steps: Any
    status: Any  # see `training`


def solved(
    name: str, method: Method, fields: AbstractVectorField, config: Config, stages: Stages, target: Dataset
) -> Solved:
    """Adapt each seed's field to its target windows, for each of the sizes, as the stage `name`."""
    windows = target.splits["train"], target.splits["validation"]

    def of_size(size: int) -> Solved:
        return jax.device_get(_solved(method, settings(config), (fields, subsets(size, config)), *windows))

    parts = stages.parts(name, [partial(of_size, size) for size in config.sizes])
    return jax.tree.map(lambda *parts: np.concatenate(parts), *parts)


# A LaneMap would use all devices, but lineax does not compile under its shard_map, and this does not take long.
# Equinox passes the options to jax.jit, but does not declare them.
@eqx.filter_jit(compiler_options=FAST_COMPILE)  # pyright: ignore[reportCallIssue]
def _solved(method: Method, shared: Settings, lanes: Any, pool: Trajectories, validation: Trajectories) -> Solved:
    def one(lane) -> Solved:
        field, subset = lane
        field, steps, status = method.solve(field, pool[subset], validation, shared)
        val_mse = rollout_mse(field, validation, solver=shared.solver)
        return Solved(field, val_mse, jnp.asarray(steps), jnp.asarray(status))

    return jax.lax.map(one, lanes)


def subsets(size: int, config: Config) -> np.ndarray:
    """The indices of the target trajectories of each seed (seeds, size)."""
    return stack([sampled_indices(seed, config)[:size] for seed in range(config.seeds)])
