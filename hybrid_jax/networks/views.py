"""Views restrict what a multirotor's residual reads of the state and which derivatives it returns.

A view is a vector field around another one: it passes features of x to it and maps its output to ẋ. Views nest: the
outer one selects the inputs, the inner one the outputs. Derivatives that a network does not return remain those of the
physics: ṗ = v and q̇ = ½ q ⊗ [0, ω] are exact for a true state, but not for the estimates in a log (see `Motion`).
"""

from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from hybrid_jax import checks, rotation
from hybrid_jax.dynamics.base import (
    AbstractVectorField,
    fuse_for_inference,
    infer_batch,
    jvp_columns,
    linearize,
    train_batch,
    update_running_stats,
)
from hybrid_jax.networks.rotor_thrust import nearness
from hybrid_jax.state import BODY_RATES, INPUT_SIZE, POSITION, QUATERNION, STATE_SIZE, VELOCITY
from hybrid_jax.vehicle import Vehicle

Features = Float[Array, " n *b"]


class AbstractView(AbstractVectorField):
    """ẋ = write(x, f(read(x), u)) for the field f inside."""

    accepts_batch: ClassVar[bool] = True

    state_size: ClassVar[int] = STATE_SIZE
    input_size: ClassVar[int] = INPUT_SIZE

    field: AbstractVectorField

    def read(self, x: Float[Array, " 13 *b"]) -> Features:
        """The features of the state that the field inside reads; by default all."""
        return x

    def write(self, x: Float[Array, " 13 *b"], inside: Features) -> Features:
        """ẋ from what the field inside returned; by default the same."""
        return inside

    def __call__(self, x: Float[Array, " d"], u: Float[Array, " m"]) -> Float[Array, " 13"]:
        return self.write(x, self.field(self.read(x), u))

    def train_batch(self, x, u):
        return self.write(x, train_batch(self.field, self.read(x), u))

    def infer_batch(self, x, u):
        return self.write(x, infer_batch(self.field, self.read(x), u))

    def update_running_stats(self, x, u):
        return eqx.tree_at(lambda view: view.field, self, update_running_stats(self.field, self.read(x), u))

    def linearize(self, x, u, dx, du):
        features, d_features = jvp_columns(self.read, (x,), (dx,))
        inside, d_inside = linearize(self.field, features, u, d_features, du)
        return jvp_columns(self.write, (x, inside), (dx, d_inside))

    def fuse_for_inference(self):
        return eqx.tree_at(lambda view: view.field, self, fuse_for_inference(self.field))


class DropXY(AbstractView):
    """Invariant to p_x and p_y: the field inside reads [p_z, q, v, ω] (11)."""

    def read(self, x):
        return x[2:]


class DropXYYaw(AbstractView):
    """Without p_x, p_y and yaw, but in world axes, in which a wind keeps its direction when the vehicle yaws.

    The field inside reads p_z [m], the world's up in the body frame Rᵀe_z (3), the velocity [m/s, world] and the body
    rates [rad/s] (10), and returns ẋ.
    """

    def read(self, x):
        up = rotation.body_z(rotation.conjugate(x[QUATERNION]))
        return jnp.concatenate([x[2:3], up, x[VELOCITY], x[BODY_RATES]])


class GroundDistance(AbstractView):
    """`DropXYYaw` with the distance to the ground: after p_z the field inside reads R / h of each rotor (14).

    The ground effect on a rotor is nearly linear in its radius R over its altitude h (Cheeseman and Bennett 1955). As a
    function of p_z it is steep and depends on the tilt.

    Attributes:
        vehicle: provides rotor positions and radius.

    Raises:
        ValueError: the vehicle's rotor radius is unknown.
    """

    vehicle: Vehicle = eqx.field(static=True)

    def __check_init__(self):
        checks.positive("vehicle.rotor_radius", self.vehicle.rotor_radius)

    def read(self, x):
        up = rotation.body_z(rotation.conjugate(x[QUATERNION]))
        return jnp.concatenate([x[2:3], nearness(x[2], up, self.vehicle), up, x[VELOCITY], x[BODY_RATES]])


class AbstractBodyView(AbstractView):
    """Equivariant to translation in x and y and to yaw: inputs and outputs are in the body frame.

    The field inside returns ṗ and v̇ in the body frame, q̇ as the quaternion r of q̇ = q ⊗ r, and ω̇.
    """

    def write(self, x, inside):
        q = x[QUATERNION]
        position, velocity = rotation.rotate(q, inside[POSITION]), rotation.rotate(q, inside[VELOCITY])
        return jnp.concatenate([position, rotation.multiply(q, inside[QUATERNION]), velocity, inside[BODY_RATES]])


class BodyFrame(AbstractBodyView):
    """The field inside reads p_z [m], the direction of gravity (3), the velocity [m/s] and the body rates [rad/s] (10).

    See `AbstractBodyView`.
    """

    def read(self, x):
        to_body = rotation.conjugate(x[QUATERNION])
        gravity = -rotation.body_z(to_body)
        return jnp.concatenate([x[2:3], gravity, rotation.rotate(to_body, x[VELOCITY]), x[BODY_RATES]])


class BodyMotion(AbstractBodyView):
    """`BodyFrame` without the height, for flight away from the ground.

    The field inside reads the velocity Rᵀv [m/s], the body rates [rad/s] and the world's up Rᵀe_z (9).
    """

    def read(self, x):
        to_body = rotation.conjugate(x[QUATERNION])
        return jnp.concatenate([rotation.rotate(to_body, x[VELOCITY]), x[BODY_RATES], rotation.body_z(to_body)])


class Accelerations(AbstractView):
    """The field inside returns v̇ and ω̇ (6), or ω̇ alone (3); the derivatives before them are exactly zero."""

    def write(self, x, inside):
        return jnp.concatenate([jnp.zeros((STATE_SIZE - len(inside), *inside.shape[1:]), inside.dtype), inside])


class Motion(AbstractView):
    """The field inside returns corrections of ṗ, of the body rates in q̇, of v̇ and of ω̇ (12), in the body frame.

    To be used inside a view that maps to the world frame: there r = ½ [0, δω], so that |q| stays 1.
    """

    def write(self, x, inside):
        turning = jnp.concatenate([jnp.zeros((1, *inside.shape[1:]), inside.dtype), inside[3:6] / 2])
        return jnp.concatenate([inside[:3], turning, inside[6:]])
