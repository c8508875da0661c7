"""Expert Augmentation (Wehenkel et al. 2023; paper, Sec. 4.7): read θ_p off the past, without data of the target.

A hybrid that was trained on the source flies with other θ_p, drawn from a box around its own, and so makes flights that
are labelled with their θ_p. An encoder learns from these, and from the source, to tell θ_p from the past. In the target
it reads the past of a flight, and the hybrid with that θ_p, its f_d as it was, predicts what comes next.

A physics whose parameters are logarithms, as `RigidBody` holds them, can be an expert: the box is made of factors.
"""

from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray

from hybrid_jax import checks
from hybrid_jax.adaptation.least_squares import parametrise
from hybrid_jax.dynamics.base import AbstractVectorField, Frozen, Hybrid, RunningStats
from hybrid_jax.integrate import rollout
from hybrid_jax.io.structure import portable
from hybrid_jax.metrics import mse
from hybrid_jax.training.objective import Settings
from hybrid_jax.trajectories import Trajectories, check, split

REAL = -1  # the ticket of a window that was flown


@portable
class Encoder(eqx.Module):
    """A perceptron from the states and inputs of the past to one number in (−1, 1) for each parameter.

    Attributes:
        weights, biases: of its layers, in order.
        seen: mean and variance of what it reads, over source flights.
    """

    weights: tuple[Float[Array, "out in"], ...]
    biases: tuple[Float[Array, " out"], ...]
    seen: RunningStats

    def __call__(self, past: Trajectories) -> Float[Array, " p"]:
        z = (read(past) - self.seen.mean) * jax.lax.rsqrt(self.seen.variance + 1e-12)
        for weight, bias in zip(self.weights[:-1], self.biases[:-1], strict=True):
            z = jax.nn.relu(weight @ z + bias)
        return jnp.tanh(self.weights[-1] @ z + self.biases[-1])


@portable
class ExpertAugmented(eqx.Module):
    """A hybrid that an encoder gives its θ_p, from the past of each flight.

    Attributes:
        encoder: what is learned.
        expert: the hybrid of the source, left as it is.
        box: lowest and highest factor on each of the expert's parameters.
    """

    encoder: Encoder
    expert: Frozen
    box: tuple[float, float] = eqx.field(static=True)

    def estimate(self, past: Trajectories) -> Float[Array, " p"]:
        """θ̂_p of one flight, as the physics holds it: inside the box whatever the past."""
        return self.inside(self.encoder(past))

    def inside(self, place: Float[Array, " p"]) -> Float[Array, " p"]:
        """The parameters at a place in the box, even in the logarithm: −1 is its low end, 1 its high end."""
        low, high = np.log(self.box)
        return self.own() + (low + high) / 2 + (high - low) / 2 * place

    def own(self) -> Float[Array, " p"]:
        """The expert's own parameters."""
        return parametrise(self.expert.field)[0]

    def flying(self, parameters: Float[Array, " p"]) -> AbstractVectorField:
        """The expert with other parameters."""
        return parametrise(self.expert.field)[1](parameters)

    def predict(self, past: Trajectories, u: Float[Array | np.ndarray, "t m"], solver=None) -> Float[Array, "t d"]:
        """The states after the end of one past flight, under the inputs that follow."""
        return rollout(self.flying(self.estimate(past)), past.x[-1], u, past.dt, solver)


def expert_augmented(
    expert: Hybrid, past: Trajectories, key: PRNGKeyArray, *, box: tuple[float, float] = (0.5, 2.0), hidden: int = 128
) -> ExpertAugmented:
    """An expert with an untrained encoder of two hidden layers.

    Args:
        past: windows of source flight, for the scale of what the encoder reads; their length is what it reads later.

    Raises:
        ValueError: the box is not 0 < low <= high, or past windows that are malformed.
    """
    if len(box) != 2 or not 0 < box[0] <= box[1] < np.inf:
        raise ValueError(f"box must be two factors, 0 < low <= high, got {box}")
    check(past, "past")
    checks.count("hidden", hidden)
    checks.key("key", key)
    readings = jax.vmap(read)(past)
    sizes = (readings.shape[1], hidden, hidden, parametrise(expert)[0].size)
    keys = jax.random.split(key, len(sizes) - 1)
    weights = tuple(
        jax.random.uniform(k, (out, fan_in), minval=-1.0, maxval=1.0) * (3 / fan_in) ** 0.5
        for k, fan_in, out in zip(keys, sizes[:-1], sizes[1:], strict=True)
    )
    seen = RunningStats(readings.mean(0), readings.var(0))
    return ExpertAugmented(Encoder(weights, tuple(jnp.zeros(out) for out in sizes[1:]), seen), Frozen(expert), box)


def read(past: Trajectories) -> Float[Array, " r"]:
    """What the encoder sees of one flight: state, change of state and input of each interval, in a row."""
    states = jnp.concatenate([jnp.asarray(past.x0)[None], jnp.asarray(past.x)])
    # The change is the state's information on ẋ; beside the states themselves it would drown in rounding.
    return jnp.concatenate([states[:-1], jnp.diff(states, axis=0), jnp.asarray(past.u)], axis=1).ravel()


class Labelled(eqx.Module):
    """Windows, each with a ticket: REAL, or the number that fixes with which θ_p the expert flies it instead."""

    windows: Trajectories
    ticket: Int[Array | np.ndarray, "*n"]

    def __len__(self) -> int:
        return len(self.windows)

    def __getitem__(self, index) -> "Labelled":
        return Labelled(self.windows[index], self.ticket[index])


@dataclass(frozen=True)
class Augmentation:
    """The objective of an `ExpertAugmented`: L_MSE of its predictions + weight × MSE(θ̂_p, θ_p) on augmented flights.

    Every source window is learned from twice: as it was flown, and as the expert flies it with a θ_p from the box.

    Attributes:
        past: intervals at the head of a window that the encoder reads; the rest is predicted.
        seed: of the θ_p.

    Raises:
        ValueError: no positive past, or a negative seed.
    """

    past: int = 10
    seed: int = 0

    def __post_init__(self):
        checks.count("past", self.past)
        checks.count("seed", self.seed, least=0)

    def prepare(self, windows: Trajectories, name: str) -> Labelled:
        check(windows, name)
        if windows.horizon <= self.past:
            raise ValueError(f"{name}: windows of {windows.horizon} intervals, more than past={self.past} expected")
        tickets = np.arange(len(windows), dtype=np.int32)
        twice = jax.tree.map(lambda leaf: np.concatenate([leaf, leaf]), windows)
        return Labelled(twice, np.concatenate([np.full_like(tickets, REAL), tickets]))

    def batch(self, picked: Labelled, settings: Settings) -> Labelled:
        return picked

    def loss(self, field: ExpertAugmented, batch: Labelled, settings: Settings, weight: Float[Array, ""]):
        prediction, label = jax.vmap(lambda one: self._errors(field, one, settings))(batch)
        augmented = batch.ticket != REAL
        return jnp.mean(prediction) + weight * jnp.sum(label * augmented) / jnp.maximum(augmented.sum(), 1), None

    def observe(self, field: ExpertAugmented, batch: Labelled, seen: None) -> ExpertAugmented:
        return field

    def validate(self, field: ExpertAugmented, data: Labelled, settings: Settings) -> Float[Array, ""]:
        errors = jax.lax.map(lambda one: self._errors(field, one, settings)[0], data, batch_size=min(250, len(data)))
        return jnp.mean(errors)

    def flown(
        self, field: ExpertAugmented, one: Labelled, settings: Settings
    ) -> tuple[Trajectories, Float[Array, " p"]]:
        """One window as it was flown, or as the expert flies it; and its θ_p."""
        key = jax.random.fold_in(jax.random.key(self.seed), one.ticket)
        own = field.own()
        drawn = field.inside(jax.random.uniform(key, own.shape, minval=-1.0, maxval=1.0))
        windows, real = one.windows, one.ticket == REAL
        other = rollout(field.flying(drawn), windows.x0, windows.u, windows.dt, settings.solver)
        states = jnp.where(real, windows.x, other)
        return Trajectories(windows.x0, windows.u, states, windows.dt), jnp.where(real, own, drawn)

    def _errors(self, field: ExpertAugmented, one: Labelled, settings: Settings):
        """Of one window: L_MSE of the prediction, and the mean squared error of θ̂_p."""
        window, theta = self.flown(field, one, settings)
        past, future = split(window, self.past)
        predicted = field.predict(past, future.u, settings.solver)
        return mse(predicted, jnp.asarray(future.x)), jnp.mean(jnp.square(field.estimate(past) - theta))


def prediction_mse(field: ExpertAugmented, windows: Trajectories, past: int, solver=None) -> Float[Array, ""]:
    """L_MSE of what is predicted after the first `past` intervals of each window, mean over windows.

    Raises:
        ValueError: windows that are malformed, or not longer than `past`.
    """
    check(windows, "windows")

    def one(window: Trajectories) -> Float[Array, ""]:
        before, after = split(window, past)
        return mse(field.predict(before, after.u, solver), jnp.asarray(after.x))

    return jnp.mean(jax.lax.map(one, windows, batch_size=min(250, len(windows))))
