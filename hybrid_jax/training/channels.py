"""A loss that divides each channel of the state by its error under a baseline, and is robust against outliers."""

from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hybrid_jax import checks
from hybrid_jax.batches import in_chunks
from hybrid_jax.dynamics.base import AbstractVectorField, state_space
from hybrid_jax.integrate import rollout_batch
from hybrid_jax.metrics import CHUNK
from hybrid_jax.training.objective import Settings, TrajectoryLoss
from hybrid_jax.trajectories import Trajectories, check, errors_of, last_measured

FLOOR = 1e-3  # least scale of a state over its size: one that hardly changes must not outweigh the others


@dataclass(frozen=True)
class Channel:
    """Consecutive entries of the state whose error is one vector, for example the velocity.

    Attributes:
        start: the first entry, counted from 0.
        stop: one past the last entry.
        scale: the norm of the error that counts as 1, in the unit of the entries.

    Raises:
        ValueError: if there are no entries, or the scale is not positive.
    """

    start: int
    stop: int
    scale: float

    def __post_init__(self):
        checks.count("start", self.start, least=0)
        checks.count("stop", self.stop, least=self.start + 1)
        checks.positive("scale", self.scale)


@dataclass(frozen=True)
class ChannelLoss(TrajectoryLoss):
    """A robust loss: Σ over channels of ρ(‖error‖ / scale), averaged over steps and windows.

    You should use it if units differ: `TrajectoryLoss` counts an error of 1 rad/s ten thousand times as much as 1 cm.
    ρ(r) = r² up to `huber`, and 2 huber r − huber² beyond (Huber 1964, doubled). No direction of an error is preferred.

    Attributes:
        channels: one or more channels. Entries of the state that are in no channel do not count.
        huber: threshold on ‖error‖ / scale beyond which ρ is linear; by default there is none.

    Raises:
        ValueError: if there are no channels, or the threshold is not positive.
    """

    channels: tuple[Channel, ...]
    huber: float | None = None

    def __post_init__(self):
        if not isinstance(self.channels, tuple) or not self.channels:
            raise ValueError(f"channels must be a nonempty tuple of Channel, got {checks.short_repr(self.channels)}")
        if self.huber is not None:
            checks.positive("huber", self.huber)

    def prepare(self, windows: Trajectories, name: str) -> Trajectories:
        widest, size = max(channel.stop for channel in self.channels), check(windows, name, missing=True).x.shape[-1]
        if size < widest:
            raise ValueError(f"{name}: states of at least {widest} numbers expected, got {size}")
        return windows

    def scale(self, d: int) -> Float[Array, " d"]:
        scale = np.full(d, np.inf)  # a state in no channel does not count
        for channel in self.channels:
            scale[channel.start : channel.stop] = channel.scale
        return jnp.asarray(scale.astype(jnp.result_type(float)))  # JAX would compile a program that converts it

    def mean_error(self, difference: Float[Array, "t d b"]) -> Float[Array, ""]:
        return jnp.mean(self.error(jnp.moveaxis(difference, 1, -1)))

    def validate(self, field: AbstractVectorField, data: Trajectories, settings: Settings) -> Float[Array, ""]:
        def errors(windows: Trajectories) -> Float[Array, " n"]:
            predicted = rollout_batch(field, windows.x0, windows.u, windows.dt, settings.solver)
            return jnp.mean(self.error(errors_of(predicted, jnp.asarray(windows.x))), axis=-1)

        return jnp.mean(in_chunks(errors, data, CHUNK))

    def error(self, difference: Float[Array, "*n d"]) -> Float[Array, "*n"]:
        """Return Σ over channels of ρ(‖error‖ / scale).

        Args:
            difference: predicted minus measured states (*n, d).
        """

        def one(channel: Channel):
            square = jnp.sum(jnp.square(difference[..., channel.start : channel.stop] / channel.scale), axis=-1)
            if self.huber is None:
                return square
            far = square > self.huber**2
            length = jnp.sqrt(jnp.where(far, square, 1.0))  # of finite slope at zero, where it is not used
            return jnp.where(far, 2 * self.huber * length - self.huber**2, square)

        return sum(map(one, self.channels[1:]), one(self.channels[0]))


def scaled_loss(field: AbstractVectorField, windows: Trajectories) -> ChannelLoss:
    """A loss relative to the RMS change over a window of each quantity in the field's state space."""
    parts = [part for part, _ in state_space(field, windows.x0.shape[-1]).parts]
    x0, end = np.asarray(windows.x0, float), last_measured(windows)[:, -1].astype(float)

    def rms(vectors: Float[np.ndarray, "n k"]) -> float:
        return float(np.sqrt(np.mean(np.sum(np.square(vectors), axis=-1))))

    scales = [max(rms(end[:, part] - x0[:, part]), FLOOR * rms(end[:, part])) or 1.0 for part in parts]
    return ChannelLoss(tuple(Channel(part.start, part.stop, s) for part, s in zip(parts, scales, strict=True)))
