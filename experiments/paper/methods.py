"""The methods of Table 2 and more baselines: each a function from a case to trained and tested models."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from experiments.paper.conditions import adaptation, settings
from experiments.paper.config import Config
from experiments.paper.lanes import Lanes, physics_in, solution, theta_of, trained
from experiments.paper.solved import Solve, by_lane, constant_disturbance, least_squares, solved, subsets
from experiments.paper.study import domain_name, places
from experiments.reporting import names
from experiments.runner.stages import Stages
from hybrid_jax.adaptation import ridge
from hybrid_jax.adaptation.expert_augmentation import prediction_mse
from hybrid_jax.adaptation.uncertainty import covariance_of, intervals
from hybrid_jax.dynamics.base import AbstractVectorField, Frozen, Hybrid, unfreeze
from hybrid_jax.dynamics.disturbance import physics_of
from hybrid_jax.dynamics.rigid_body import RigidBody
from hybrid_jax.io.datasets import Dataset
from hybrid_jax.sweep.lanes import lane
from hybrid_jax.sweep.training import evaluate
from hybrid_jax.training.fitting import STOPPED, FitState
from hybrid_jax.trajectories import Trajectories, split

PAST = 10  # intervals of a test window before the ones to predict
Method = Literal[
    "hybrid", "no_physics", "physics_only", "expert_augmentation", "theta_p_only", "theta_d_only", "last_layer",
    "least_squares", "constant_disturbance", "linear_residual",
]  # fmt: skip


@dataclass(frozen=True)
class Case:
    """The data and models that a method may use in one target domain.

    Attributes:
        pretrained: by model, the final states of its pre-training, one per seed.
        experts: the trained `ExpertAugmented` of all seeds, if Expert Augmentation is compared.
        target: splits train (the pool), validation and test_with_past.
    """

    config: Config
    stages: Stages
    pretrained: Mapping[str, FitState]
    experts: FitState | None
    target: Dataset

    @property
    def name(self) -> str:
        """The target domain."""
        return domain_name(self.target)

    def tested(self, name: str, fields: Any) -> np.ndarray:
        """L^T_MSE of stacked fields on the steps after the past."""
        _, future = split(self.target.splits["test_with_past"], PAST)
        return self.stages.timed(f"test {name} {self.name}", lambda: evaluate(fields, future, 1, settings(self.config)))


def tuned(model: str, mark: Callable[[Any], AbstractVectorField] = lambda field: field) -> Callable[[Case, str], Lanes]:
    """Fine-tune a pre-trained model by Adam, except the parts that `mark` freezes."""

    def method(case: Case, name: str) -> Lanes:
        config = case.config
        starts, plans = adaptation(model, names.FINE_TUNED, mark(case.pretrained[model].best), config)
        final = case.stages.run(f"{names.FINE_TUNED} {name} {case.name}", starts, plans, settings(config), case.target)
        whole = eqx.tree_at(lambda state: state.best, final, unfreeze(final.best))
        errors = case.tested(name, whole.best)
        return with_intervals(case, trained(name, names.FINE_TUNED, *places(config.sizes, config), whole, errors))

    return method


def found_by(solve: Solve) -> Callable[[Case, str], Lanes]:
    """Adapt the hybrid by a solver instead of training."""

    def method(case: Case, name: str) -> Lanes:
        config, start = case.config, case.pretrained[names.HYBRID].best
        found = solved(f"{names.FINE_TUNED} {name} {case.name}", solve, start, config, case.stages, case.target)
        errors = case.tested(name, found.fields)
        return with_intervals(case, solution(name, *places(config.sizes, config), found, errors))

    return method


def source_only(model: str) -> Callable[[Case], Lanes]:
    """The pre-trained model, unchanged."""

    def method(case: Case) -> Lanes:
        final = case.pretrained[model]
        errors = case.tested(f"{names.SOURCE_ONLY} {model}", final.best)
        return trained(model, names.SOURCE_ONLY, *places((0,), case.config), final, errors)

    return method


def augmented(case: Case, name: str) -> Lanes:
    """Expert Augmentation: the encoder estimates θ_p of each test window from its past; it uses no target data."""
    assert case.experts is not None
    solver = settings(case.config).solver
    windows = case.target.splits["test_with_past"]

    def one(model, windows: Trajectories):
        past, _ = split(windows, PAST)
        typical = jnp.mean(jax.lax.map(model.estimate, past, batch_size=min(250, len(past))), axis=0)
        return prediction_mse(model, windows, PAST, solver), physics_of(model.with_parameters(typical))

    experts = case.experts
    errors, physics = case.stages.timed(f"test {name} {case.name}", lambda: by_lane(one, experts.best, windows))
    lanes = trained(name, names.SOURCE_ONLY, *places((0,), case.config), experts, errors)
    return replace(lanes, theta=theta_of(physics))


def with_intervals(case: Case, lanes: Lanes) -> Lanes:
    """The models with the 95 % interval of θ_p from the windows of their adaptation, if θ_p was adapted.

    The interval treats the network as fixed. It would do so with a disturbance too, so models that fitted one get none.
    """
    without = (names.THETA_D_ONLY, names.CONSTANT_DISTURBANCE, *CLOSED_FORM)
    if not isinstance(physics_in(lanes.fields), RigidBody) or lanes.model in without:
        return lanes
    solver = settings(case.config).solver

    def one(lane, pool: Trajectories):
        field, subset = lane
        found = intervals(field, covariance_of(field, pool[subset], solver=solver))
        return {name: jnp.stack([interval.low, interval.high]) for name, interval in found.items()}

    def of_size(index: int, size: int):
        seeds = case.config.seeds
        fields = lane(lanes.fields, np.arange(index * seeds, (index + 1) * seeds))
        return by_lane(one, (fields, subsets(size, case.config)), case.target.splits["train"])

    parts = case.stages.timed(
        f"intervals {lanes.model} {case.name}",
        lambda: [of_size(index, size) for index, size in enumerate(case.config.sizes)],
    )
    return replace(lanes, intervals=jax.tree.map(lambda *ends: np.concatenate(ends), *parts))


def _ridge(method) -> Callable[[Case, str], Lanes]:
    def solve(field, train, validation, shared):
        return ridge.fit_ridge(method, field, train, validation, settings=shared).field, 0, STOPPED

    return found_by(solve)


CLOSED_FORM = {
    names.LAST_LAYER: _ridge(ridge.last_layer),
    names.LINEAR_RESIDUAL: _ridge(ridge.linear_residual),
}
METHODS: Mapping[str, Callable[[Case, str], Lanes]] = {
    names.HYBRID: tuned(names.HYBRID),
    names.NO_PHYSICS: tuned(names.NO_PHYSICS),
    names.PHYSICS_ONLY: tuned(names.PHYSICS_ONLY),
    names.EXPERT_AUGMENTATION: augmented,
    names.THETA_P_ONLY: tuned(names.HYBRID, lambda field: Hybrid(field.physics, Frozen(field.residual))),
    names.THETA_D_ONLY: tuned(names.HYBRID, lambda field: Hybrid(Frozen(field.physics), field.residual)),
    names.LEAST_SQUARES: found_by(least_squares),
    names.CONSTANT_DISTURBANCE: found_by(constant_disturbance),
    **CLOSED_FORM,
}
