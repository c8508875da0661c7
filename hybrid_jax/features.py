"""What a multirotor's residual may read of the state and what it may write: views around any network.

A view is a vector field that hands features of x to the field inside and turns its answer into ẋ. Views nest: the outer
one chooses what is read, the inner one what is written. What is not read cannot be overfitted: drag knows no place, and
neither drag nor ground effect knows north. What is not written stays physics: ṗ = v and q̇ = ½ q ⊗ [0, ω] are exact.

The code reads x[0], x[1], …, so x (13,) and u (4,) may carry trailing batch axes.
"""

from abc import abstractmethod
from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from hybrid_jax import rotation
from hybrid_jax.residual import InputScaling, residual_network
from hybrid_jax.state import BODY_RATES, INPUT_SIZE, POSITION, QUATERNION, STATE_SIZE, VELOCITY
from hybrid_jax.vector_field import AbstractVectorField, deploy_batch, evaluate_batch, observe

Features = Float[Array, " n *b"]


class View(AbstractVectorField):
    """ẋ = write(x, f(read(x), u)) for the field f inside."""

    field: eqx.AbstractVar[AbstractVectorField]

    @abstractmethod
    def read(self, x: Float[Array, " d *b"]) -> Features:
        """What the field inside sees of the state."""

    @abstractmethod
    def write(self, x: Float[Array, " d *b"], inside: Features) -> Features:
        """ẋ from what the field inside returned."""

    def __call__(self, x: Float[Array, " d"], u: Float[Array, " m"]) -> Float[Array, " 13"]:
        return self.write(x, self.field(self.read(x), u))


class Placeless(View):
    """Blind to p_x and p_y: the field inside reads [p_z, q, v, ω] (11)."""

    field: AbstractVectorField

    def read(self, x):
        return x[2:]

    def write(self, x, inside):
        return inside


class BodyFrame(View):
    """Blind to p_x, p_y and yaw: all is seen from the body, and turned into the world afterwards.

    The field inside reads p_z [m], the direction of gravity (3), the velocity [m/s] (3) and the body rates [rad/s] (3),
    all in the body frame; it returns ṗ and v̇ in the body frame, q̇ as the quaternion r of q̇ = q ⊗ r, and ω̇. So a
    vehicle that is turned about the world's vertical has a derivative that is turned with it.
    """

    field: AbstractVectorField

    def read(self, x):
        to_body = rotation.conjugate(x[QUATERNION])
        gravity = -rotation.body_z(to_body)
        return jnp.concatenate([x[2:3], gravity, rotation.rotate(to_body, x[VELOCITY]), x[BODY_RATES]])

    def write(self, x, inside):
        q = x[QUATERNION]
        return jnp.concatenate(
            [
                rotation.rotate(q, inside[POSITION]),
                rotation.multiply(q, inside[QUATERNION]),
                rotation.rotate(q, inside[VELOCITY]),
                inside[BODY_RATES],
            ]
        )


class Accelerations(View):
    """The field inside returns v̇ and ω̇ (6); ṗ and q̇ are exactly zero."""

    field: AbstractVectorField

    def read(self, x):
        return x

    def write(self, x, inside):
        return jnp.concatenate([jnp.zeros((VELOCITY.start, *inside.shape[1:]), inside.dtype), inside])


@evaluate_batch.register
def _(field: View, x, u):
    return field.write(x, evaluate_batch(field.field, field.read(x), u))


@deploy_batch.register
def _(field: View, x, u):
    return field.write(x, deploy_batch(field.field, field.read(x), u))


@observe.register
def _(field: View, x, u):
    return eqx.tree_at(lambda view: view.field, field, observe(field.field, field.read(x), u))


def _as_it_is(field: AbstractVectorField) -> AbstractVectorField:
    return field


Wrapper = Callable[[AbstractVectorField], AbstractVectorField]

# Name → how many numbers the network reads beside u, or returns, and the view around it.
INPUTS: dict[str, tuple[int, Wrapper]] = {
    "all": (STATE_SIZE, _as_it_is),
    "no_xy": (STATE_SIZE - 2, Placeless),
    "body": (10, BodyFrame),
}
OUTPUTS: dict[str, tuple[int, Wrapper]] = {"all": (STATE_SIZE, _as_it_is), "accelerations": (6, Accelerations)}


def restricted(
    key: PRNGKeyArray,
    *,
    inputs: str = "all",
    outputs: str = "all",
    hidden: int = 64,
    norm: str = "batch",
    scaling: InputScaling | None = None,
) -> AbstractVectorField:
    """A network that reads and writes only part of a multirotor's state; by default all of it, as the paper's.

    Args:
        inputs: "all" of x; "no_xy", without p_x and p_y; "body", seen from the body (see `BodyFrame`).
        outputs: "all" 13 derivatives, or the "accelerations" v̇ and ω̇.
        norm: as in `residual_network`.

    Raises:
        ValueError: another name.
    """
    for name, value, known in (("inputs", inputs, INPUTS), ("outputs", outputs, OUTPUTS)):
        if value not in known:
            raise ValueError(f"{name} must be one of {', '.join(known)}, got {value!r}")
    (reads, seen), (writes, written) = INPUTS[inputs], OUTPUTS[outputs]
    network = residual_network(reads, INPUT_SIZE, key, hidden=hidden, scaling=scaling, norm=norm, outputs=writes)
    return seen(written(network))
