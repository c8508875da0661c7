"""A disturbance that is predicted from its own past, for example of a load that swings where no sensor sees it."""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from hybrid_jax.dynamics.base import AbstractVectorField, state_space


class DisturbanceModel(AbstractVectorField):
    """A disturbance that is predicted from its past: ẋ = f(x, u) + D e, żᵢ = (e − zᵢ) / τᵢ, e = W (z₁, …, z_k, x, 1).

    The state is (x, z₁, …, z_k). e is the disturbance in the tangent space of x, D its effect on ẋ, and zᵢ is e after a
    filter. While x is measured, e is the measured disturbance instead: see `hybrid_jax.estimation.observe`. This is an
    innovations form of linear hidden dynamics (Ljung, System Identification, 1999, 4.3) with fixed poles.

    Attributes:
        field: f, with d states and e numbers in their tangent space.
        weights: W (e, k e + n + 1), in the units of ẋ, z and x.
        sizes: by how much each number that W multiplies varied in the data of the first fit (k e + n + 1), in its unit;
            infinite for a state that did not vary.
        time_constants: time constants τ₁, …, τ_k of the filters [s].
        states: indices of the n states that W reads.
    """

    field: AbstractVectorField
    weights: Float[Array, "e f"]
    sizes: Float[Array, " f"]
    time_constants: tuple[float, ...] = eqx.field(static=True)
    states: tuple[int, ...] = eqx.field(static=True)

    @property
    def filters(self) -> int:
        """The number of filter states, which follow the states of the field."""
        return len(self.time_constants) * len(self.weights)

    @property
    def state_space(self):
        own = state_space(self.field)
        return own.padded(own.size + self.filters)

    def disturbance(self, x: Float[Array, " d+f"]) -> Float[Array, " e"]:
        """Predict the disturbance e (e,) in a state, in the state's units per second.

        Args:
            x: the state of the field, followed by the states of the filters.
        """
        d = len(x) - self.filters
        return self.weights @ jnp.concatenate([x[d:], x[jnp.array(self.states, int)], jnp.ones(1, x.dtype)])

    def __call__(self, x: Float[Array, " d+f"], u: Float[Array, " m"]) -> Float[Array, " d+f"]:
        own, filtered = x[: len(x) - self.filters], x[len(x) - self.filters :]
        e = self.disturbance(x)
        retract = partial(state_space(self.field, len(own)).retract, own)
        _, effect = jax.jvp(retract, (jnp.zeros_like(e),), (e,))
        slopes = (e - filtered.reshape(-1, len(e))) / jnp.array(self.time_constants, x.dtype)[:, None]
        return jnp.concatenate([self.field(own, u) + effect, slopes.ravel()])
