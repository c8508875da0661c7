"""Expert Augmentation (Wehenkel et al. 2023; paper, Sec. 4.7): an encoder estimates θ_p from the past of a flight.

It learns from rollouts of a source hybrid (the expert) with θ_p drawn from a box of factors around its own.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray

from hybrid_jax.dynamics.base import AbstractVectorField, RunningStats
from hybrid_jax.dynamics.composition import Frozen, Hybrid
from hybrid_jax.estimation.least_squares import Solver, Theta, ravel_parameters
from hybrid_jax.integrate import rollout
from hybrid_jax.io.structure import portable
from hybrid_jax.metrics import mse
from hybrid_jax.training.objective import Objective, Settings
from hybrid_jax.trajectories import Trajectories, check, split

RECORDED = -1  # the augmentation_seed of a recorded window


@portable
class Encoder(eqx.Module):
    """A perceptron from past states and inputs to one number in (−1, 1) for each parameter.

    Attributes:
        weights: of each layer (out, in), in order.
        biases: of each layer (out,).
        seen: mean and variance of its inputs over source flights.
    """

    weights: tuple[Float[Array, "out in"], ...]
    biases: tuple[Float[Array, " out"], ...]
    seen: RunningStats

    def __call__(self, past: Trajectories) -> Theta:
        z = (encoder_inputs(past) - self.seen.mean) * jax.lax.rsqrt(self.seen.variance + 1e-12)
        for weight, bias in zip(self.weights[:-1], self.biases[:-1], strict=True):
            z = jax.nn.relu(weight @ z + bias)
        return jnp.tanh(self.weights[-1] @ z + self.biases[-1])


@portable
class ExpertAugmented(eqx.Module):
    """A hybrid whose θ_p an encoder estimates from the past of each flight.

    Attributes:
        encoder: a network from the past of a flight to a place in the box.
        expert: the source's hybrid, which does not change.
        box: the lowest and highest factor on each of the expert's parameters.
    """

    encoder: Encoder
    expert: Frozen
    box: tuple[float, float] = eqx.field(static=True)

    def typical(self, past: Trajectories) -> AbstractVectorField:
        """Return the expert with the mean estimate of θ_p over windows."""
        return self.with_parameters(_mean_over(self.estimate, past))

    def estimate(self, past: Trajectories) -> Theta:
        """Estimate θ_p of one flight in the physics' own parametrisation; the estimate is always inside the box."""
        return self.inside(self.encoder(past))

    def inside(self, place: Theta) -> Theta:
        """Return the parameters at a place in the box, uniform in the logarithm: −1 is its low end, 1 its high end."""
        (low, high), (own, _) = np.log(self.box), ravel_parameters(self.expert.field)
        return own + (low + high) / 2 + (high - low) / 2 * place

    def with_parameters(self, parameters: Theta) -> AbstractVectorField:
        return ravel_parameters(self.expert.field)[1](parameters)

    def predict(
        self, past: Trajectories, u: Float[Array | np.ndarray, "t m"], solver: Solver = None
    ) -> Float[Array, "t d"]:
        """Predict the states after one past flight, under the inputs u."""
        return rollout(self.with_parameters(self.estimate(past)), past.x[-1], u, past.dt, solver)


def expert_augmented(
    expert: Hybrid, past: Trajectories, key: PRNGKeyArray, *, box: tuple[float, float] = (0.5, 2.0), hidden: int = 128
) -> ExpertAugmented:
    """Build an expert, whose physics stores its parameters as logarithms, with an untrained encoder of two layers.

    Past windows of the source are as long as the encoder will read, and set the scale of its inputs.
    """
    inputs = jax.vmap(encoder_inputs)(past)
    sizes = (inputs.shape[1], hidden, hidden, ravel_parameters(expert)[0].size)
    keys = jax.random.split(key, len(sizes) - 1)
    weights = tuple(
        jax.random.uniform(k, (out, fan_in), minval=-1.0, maxval=1.0) * (3 / fan_in) ** 0.5
        for k, fan_in, out in zip(keys, sizes[:-1], sizes[1:], strict=True)
    )
    seen = RunningStats(inputs.mean(0), inputs.var(0))
    return ExpertAugmented(Encoder(weights, tuple(map(jnp.zeros, sizes[1:])), seen), Frozen(expert), box)


def encoder_inputs(past: Trajectories) -> Float[Array, " r"]:
    """Concatenate state, change of state and input of each interval of one flight."""
    states = jnp.concatenate([jnp.asarray(past.x0)[None], jnp.asarray(past.x)])
    # The change carries the information on ẋ; computed by the encoder from states it would be lost in rounding.
    return jnp.concatenate([states[:-1], jnp.diff(states, axis=0), jnp.asarray(past.u)], axis=1).ravel()


class Labelled(Trajectories):
    """Windows that are used as recorded or as flown by the expert.

    Attributes:
        augmentation_seed: seed of θ_p for each window that the expert flies, or RECORDED.
    """

    augmentation_seed: Int[Array | np.ndarray, "*n"]


@dataclass(frozen=True)
class Augmentation(Objective):
    """The objective of an `ExpertAugmented`: L_MSE of its predictions + weight × MSE(θ̂_p, θ_p) on augmented flights.

    Every source window is used twice: as recorded, and as flown by the expert with a θ_p from the box.

    Attributes:
        past: number of intervals at the start of a window that the encoder reads; the rest is predicted.
        seed: random seed of θ_p.
    """

    past: int = 10
    seed: int = 0

    def prepare(self, windows: Trajectories, name: str) -> Labelled:
        check(windows, name)
        if windows.horizon <= self.past:
            raise ValueError(f"{name}: windows of {windows.horizon} intervals, more than past={self.past} expected")
        seeds = np.arange(len(windows), dtype=np.int32)
        twice = jax.tree.map(lambda leaf: np.concatenate([leaf, leaf]), windows)
        return Labelled(**vars(twice), augmentation_seed=np.concatenate([np.full_like(seeds, RECORDED), seeds]))

    def loss(self, field: ExpertAugmented, batch: Labelled, settings: Settings, weight: Float[Array, ""]):
        prediction, label = jax.vmap(lambda one: self._errors(field, one, settings))(batch)
        augmented = batch.augmentation_seed != RECORDED
        return jnp.mean(prediction) + weight * jnp.sum(label * augmented) / jnp.maximum(augmented.sum(), 1), None

    def validate(self, field: ExpertAugmented, data: Labelled, settings: Settings) -> Float[Array, ""]:
        return _mean_over(lambda one: self._errors(field, one, settings)[0], data)

    def augmented(self, field: ExpertAugmented, one: Labelled, settings: Settings) -> tuple[Trajectories, Theta]:
        """Return one window, as recorded or as flown by the expert, and its θ_p."""
        own, _ = ravel_parameters(field.expert.field)
        key = jax.random.fold_in(jax.random.key(self.seed), one.augmentation_seed)
        drawn = field.inside(jax.random.uniform(key, own.shape, minval=-1.0, maxval=1.0))
        recorded = one.augmentation_seed == RECORDED
        other = rollout(field.with_parameters(drawn), one.x0, one.u, one.dt, settings.solver)
        return replace(one, x=jnp.where(recorded, one.x, other)), jnp.where(recorded, own, drawn)

    def _errors(self, field: ExpertAugmented, one: Labelled, settings: Settings):
        """Return L_MSE of the prediction of one window, and the mean squared error of θ̂_p."""
        window, theta = self.augmented(field, one, settings)
        error = _window_mse(field, window, self.past, settings.solver)
        return error, jnp.mean(jnp.square(field.estimate(split(window, self.past)[0]) - theta))


def prediction_mse(field: ExpertAugmented, windows: Trajectories, past: int, solver=None) -> Float[Array, ""]:
    """Average L_MSE of the prediction after the first `past` intervals over windows."""
    return _mean_over(lambda window: _window_mse(field, window, past, solver), windows)


def _window_mse(field: ExpertAugmented, window: Trajectories, past: int, solver) -> Float[Array, ""]:
    before, after = split(window, past)
    return mse(field.predict(before, after.u, solver), jnp.asarray(after.x))


def _mean_over(function: Callable[[Any], Float[Array, "*p"]], windows: Any) -> Float[Array, "*p"]:
    return jnp.mean(jax.lax.map(function, windows, batch_size=min(250, len(windows))), axis=0)
