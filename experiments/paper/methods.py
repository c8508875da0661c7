"""The methods of Table 2 and more baselines: from a case to trained and tested models."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, Literal

import equinox as eqx
import jax
import numpy as np

from experiments.paper.conditions import settings
from experiments.paper.config import Config
from experiments.paper.expert_augmentation import prediction_mse
from experiments.paper.lanes import MODELS, Fit, Lanes, lanes_of, source_of, theta_of
from experiments.paper.study import SOLVED, solved
from experiments.paper.study import adapted as trained
from experiments.reporting import names
from experiments.runner.stages import Stages
from hybrid_jax.dynamics.composition import Frozen, Hybrid, unfreeze
from hybrid_jax.dynamics.disturbance import physics_of
from hybrid_jax.io.datasets import Dataset
from hybrid_jax.runtime import FAST_COMPILE
from hybrid_jax.sweep.training import evaluate
from hybrid_jax.trajectories import Trajectories, split

PAST = 10  # intervals of a test window before the ones to predict
if TYPE_CHECKING:
    Method = str
else:
    Method = Literal[MODELS]


@dataclass(frozen=True)
class Case:
    """Data and models for the methods in one target domain, with a pool of training windows."""

    config: Config
    stages: Stages
    pretrained: Mapping[str, Fit]
    experts: Fit | None
    target: Dataset

    @property
    def name(self) -> str:
        return self.target.config["domain"]

    def tested(self, name: str, fields: Any) -> np.ndarray:
        _, future = split(self.target.splits["test_with_past"], PAST)
        return self.stages.timed(
            f"test {name} {self.name}", lambda: evaluate(fields, future, 1, settings(self.config)), "testing"
        )


def source_only(case: Case, model: str) -> Lanes:
    fit, mode = case.pretrained[model], names.SOURCE_ONLY
    errors = case.tested(f"{mode} {model}", fit.fields)
    return lanes_of(case.name, model, mode, (0,), case.config.seeds, fit, errors)


def adapted(case: Case, method: Method) -> Lanes:
    """Adapt the source models by a method: Adam, an encoder, or a method of the library."""
    if method == names.EXPERT_AUGMENTATION:
        return _augmented(case)
    config, mode, model = case.config, names.FINE_TUNED, source_of(method)
    start, stage = case.pretrained[model].fields, f"{mode} {method} {case.name}"
    if method in SOLVED:
        fit = solved(stage, SOLVED[method], start, config, case.stages, case.target)
    else:
        if method == names.THETA_P_ONLY:
            start = Hybrid(start.physics, Frozen(start.residual))
        elif method == names.THETA_D_ONLY:
            start = Hybrid(Frozen(start.physics), start.residual)
        fit = trained(model, mode, start, config, case.stages, case.target, method)
        fit = fit._replace(fields=unfreeze(fit.fields))
    errors = case.tested(method, fit.fields)
    return lanes_of(case.name, method, mode, config.sizes, config.seeds, fit, errors)


def _augmented(case: Case) -> Lanes:
    """Expert Augmentation: the encoder estimates θ_p of each test window from its past, without target data."""
    name, experts, windows = names.EXPERT_AUGMENTATION, case.experts, case.target.splits["test_with_past"]
    assert experts is not None

    encoded = partial(_encoded, experts.fields, windows, settings(case.config).solver)
    errors, physics = case.stages.timed(f"test {name} {case.name}", lambda: jax.device_get(encoded()), "testing")
    seeds = case.config.seeds
    return lanes_of(case.name, name, names.SOURCE_ONLY, (0,), seeds, experts, errors, theta_of(physics))


@eqx.filter_jit(compiler_options=FAST_COMPILE)  # pyright: ignore[reportCallIssue]
def _encoded(experts, windows: Trajectories, solver):
    """Return the test error of each model, and its physics with the mean estimate of θ_p."""
    past, _ = split(windows, PAST)

    def one(model):
        return prediction_mse(model, windows, PAST, solver), physics_of(model.typical(past))

    return jax.lax.map(one, experts)
