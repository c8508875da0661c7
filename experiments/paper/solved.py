"""Adaptation by least squares or in closed form, for every size and seed."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from experiments.paper.conditions import sampled_indices, settings
from experiments.paper.config import Config
from experiments.runner.stages import Stages
from hybrid_jax.adaptation.disturbance_selection import select_disturbance
from hybrid_jax.adaptation.least_squares import LeastSquaresFit, fit_least_squares
from hybrid_jax.dynamics.base import AbstractVectorField
from hybrid_jax.dynamics.disturbance import with_disturbance
from hybrid_jax.io.datasets import Dataset
from hybrid_jax.metrics import rollout_mse
from hybrid_jax.runtime import FAST_COMPILE
from hybrid_jax.sweep.lanes import stack
from hybrid_jax.sweep.training import PROGRAMS
from hybrid_jax.training.fitting import CAPPED, DIVERGED, STOPPED
from hybrid_jax.training.objective import Settings
from hybrid_jax.trajectories import Trajectories

# From a field, the windows to adapt to and those to validate with: the adapted field, steps and status.
Solve = Callable[[Any, Trajectories, Trajectories, Settings], tuple[AbstractVectorField, Any, Any]]


class Solved(NamedTuple):
    """Adapted models, one for each size and seed, in the order of `study.places`.

    Attributes:
        fields: the models, stacked.
        val_mse: L_MSE on the validation windows, of each.
        steps: of the solver, of each.
        status: see `training`, of each.
    """

    fields: Any
    val_mse: Any
    steps: Any
    status: Any


def solved(
    name: str, solve: Solve, fields: AbstractVectorField, config: Config, stages: Stages, target: Dataset
) -> Solved:
    """Adapt each seed's field to its target windows, for each of the sizes.

    Args:
        name: of the stage.
    """
    one = _Lane(solve, settings(config))

    def of_size(size: int) -> Solved:
        lanes = (fields, subsets(size, config))
        return by_lane(one, lanes, target.splits["train"], target.splits["validation"])

    parts = stages.parts(name, [partial(of_size, size) for size in config.sizes])
    return jax.tree.map(lambda *parts: np.concatenate(parts), *parts)


@dataclass(frozen=True)
class _Lane:
    """The adaptation of one model. Instances compare equal for all targets, so these share a compiled program."""

    solve: Solve
    shared: Settings

    def __call__(self, lane: Any, pool: Trajectories, validation: Trajectories) -> Solved:
        field, subset = lane
        field, steps, status = self.solve(field, pool[subset], validation, self.shared)
        val_mse = rollout_mse(field, validation, solver=self.shared.solver)
        return Solved(field, val_mse, jnp.asarray(steps), jnp.asarray(status))


def least_squares(field, train: Trajectories, validation: Trajectories, shared: Settings):
    """θ_p by least squares; the network is fixed."""
    return _solution(fit_least_squares(field, train, shared.solver))


def constant_disturbance(field, train: Trajectories, validation: Trajectories, shared: Settings):
    """θ_p and a constant disturbance (9 parameters) by least squares; the network is fixed."""
    return least_squares(with_disturbance(field), train, validation, shared)


def needed_disturbance(field, train: Trajectories, validation: Trajectories, shared: Settings):
    """As `constant_disturbance`, with the disturbance at zero unless it improves left-out windows."""
    return _solution(select_disturbance(field, train, shared.solver).fit)


def _solution(found: LeastSquaresFit):
    status = jnp.where(found.converged, STOPPED, jnp.where(jnp.isfinite(found.mse), CAPPED, DIVERGED))
    return found.field, found.steps, status


def by_lane(function: Callable[..., Any], lanes: Any, *shared: Any) -> Any:
    """`function(lane, *shared)` of each lane, in sequence in one program, as host arrays."""
    return jax.device_get(_mapped(function)(lanes, shared))


# A LaneMap would use all devices, but lineax does not compile under its shard_map, and this does not take long.
@lru_cache(PROGRAMS)
def _mapped(function: Callable[..., Any]) -> Callable[..., Any]:
    def mapped(lanes, shared):
        return jax.lax.map(lambda lane: function(lane, *shared), lanes)

    # Equinox passes the options to jax.jit, but does not declare them.
    return eqx.filter_jit(mapped, compiler_options=FAST_COMPILE)  # pyright: ignore[reportCallIssue]


def subsets(size: int, config: Config) -> np.ndarray:
    """The indices of the target trajectories of each seed (seeds, size)."""
    return stack([sampled_indices(seed, config)[:size] for seed in range(config.seeds)])
