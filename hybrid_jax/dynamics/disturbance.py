"""A constant disturbance of a multirotor: the simplest thing that a change can bring which its physics has no name for.

A steady wind, a load off centre, a bent blade: all of them push or turn the vehicle by what hardly changes in a window.
Six numbers hold that, and together with θ_p least squares finds them from seconds of flight, where a network that was
taught by plenty of flight would forget some of it:

    fit_least_squares(with_disturbance(hybrid), windows).field

Whether there is such a push the windows tell as well: see `disturbance_fit.fit_with_selected_disturbance`.
"""

from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from hybrid_jax import checks
from hybrid_jax.dynamics.base import AbstractVectorField, Hybrid
from hybrid_jax.state import STATE_SIZE, VELOCITY

SIZE = STATE_SIZE - VELOCITY.start


class ConstantDisturbance(AbstractVectorField):
    """ẋ = [0, 0, a, α], whatever x and u are.

    The code serves a batch as it stands: x (13,) and u (4,) may carry trailing batch axes.

    Attributes:
        acceleration: a [m/s², world] and α [rad/s², body].
    """

    accepts_batch: ClassVar[bool] = True

    acceleration: Float[Array, "6"]

    def __call__(self, x: Float[Array, " 13 *b"], u: Float[Array, " 4 *b"]) -> Float[Array, " 13 *b"]:
        return jnp.broadcast_to(self.of_all.reshape(-1, *(1,) * (x.ndim - 1)), x.shape)

    @property
    def of_all(self) -> Float[Array, "13"]:
        """ẋ of any state."""
        return jnp.concatenate([jnp.zeros(VELOCITY.start, self.acceleration.dtype), self.acceleration])


def disturbed(field: AbstractVectorField, acceleration: Float[Array, "6"]) -> Hybrid:
    """ẋ = f(x, u) + [0, 0, a, α]: any field and a constant disturbance, as in `ConstantDisturbance`."""
    return Hybrid(field, ConstantDisturbance(acceleration))


def with_disturbance(field: Hybrid) -> Hybrid:
    """A hybrid whose physics has a constant disturbance of zero beside it, which `fit_least_squares` fits too.

    Raises:
        ValueError: no hybrid.
    """
    if not isinstance(field, Hybrid):
        raise ValueError(f"field must be a Hybrid, got {checks.short_repr(field)}")
    dtypes = (leaf.dtype for leaf in jax.tree.leaves(eqx.filter(field.physics, eqx.is_inexact_array)))
    return Hybrid(disturbed(field.physics, jnp.zeros(SIZE, jnp.result_type(*dtypes, jnp.float32))), field.residual)
