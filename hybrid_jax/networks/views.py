"""Views restrict what a multirotor's residual reads of the state and which derivatives it returns.

Views nest: the outer one selects the inputs, the inner one the outputs. Derivatives that a network does not return are
those of the physics: ṗ = v and q̇ = ½ q ⊗ [0, ω] are exact for a true state, but not for estimates (see `Motion`).
"""

from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from hybrid_jax import checks, rotation
from hybrid_jax.dynamics.base import AbstractVectorField, as_field, jvp_columns
from hybrid_jax.dynamics.composition import AbstractWrapper
from hybrid_jax.dynamics.equations import dot
from hybrid_jax.state import BODY_RATES, INPUT_SIZE, POSITION, QUATERNION, STATE_SIZE, VELOCITY
from hybrid_jax.vehicle import Vehicle


class AbstractView(AbstractWrapper):
    """A wrapper whose state and input are a multirotor's (state.py)."""

    state_size: ClassVar[int] = STATE_SIZE
    input_size: ClassVar[int] = INPUT_SIZE


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
        return jnp.concatenate([x[2:3], _up(x), x[VELOCITY], x[BODY_RATES]])


class GroundDistance(AbstractView):
    """`DropXYYaw` with the distance to the ground: after p_z the field inside reads R / h of each rotor (14).

    The ground effect on a rotor is nearly linear in its radius R over its altitude h (Cheeseman and Bennett 1955). As a
    function of p_z it is steep and depends on the tilt.

    Raises:
        ValueError: the rotor radius of `vehicle` is unknown.
    """

    vehicle: Vehicle = eqx.field(static=True)

    def __check_init__(self):
        checks.positive("vehicle.rotor_radius", self.vehicle.rotor_radius)

    def read(self, x):
        up = _up(x)
        return jnp.concatenate([x[2:3], _nearness(x, up, self.vehicle), up, x[VELOCITY], x[BODY_RATES]])


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


class RotorThrust(AbstractVectorField):
    """v̇ and ω̇ of a thrust k uᵢ² f(R / hᵢ, uᵢ) of each rotor along the body's z axis, k and inertia the nominal ones.

    By dimensional analysis, the ground effect on a rotor in hover is a function of its radius R over its altitude h
    (Cheeseman and Bennett 1955). One network learns it from the data of every rotor: the vehicle's geometry says where
    each thrust acts, so that force and torque follow. The other derivatives are exactly zero.

    Attributes:
        field: f, from one state and one input to one number, without batch normalisation.
        vehicle: provides rotor positions, radius, and nominal constants.

    Raises:
        ValueError: the vehicle's rotor radius is unknown.
    """

    accepts_batch: ClassVar[bool] = True

    field: AbstractVectorField
    vehicle: Vehicle = eqx.field(static=True)

    def __check_init__(self):
        checks.positive("vehicle.rotor_radius", self.vehicle.rotor_radius)

    def __call__(self, x: Float[Array, " 13 *b"], u: Float[Array, " rotors *b"]) -> Float[Array, " 13 *b"]:
        return self.write(x, u, self.share(self.read(x), u))

    def fuse_for_inference(self):
        return RotorThrust(as_field(self.field).fuse_for_inference(), self.vehicle)

    def linearize(self, x, u, dx, du):
        """Two derivatives of the network for each rotor, whatever the number of directions."""
        near, d_near = jvp_columns(self.read, (x,), (dx,))
        share, pullback = jax.vjp(self.share, near, u)
        by_near, by_u = pullback(jnp.ones_like(share))
        d_share = by_near[:, None] * d_near + by_u[:, None] * du
        return jvp_columns(self.write, (x, u, share), (dx, du, d_share))

    def read(self, x: Float[Array, " 13 *b"]) -> Float[Array, " rotors *b"]:
        """R / h of each rotor."""
        return _nearness(x, _up(x), self.vehicle)

    def share(self, near: Float[Array, " rotors *b"], u: Float[Array, " rotors *b"]) -> Float[Array, " rotors *b"]:
        """f of each rotor.

        Args:
            near: R / h of each rotor (rotors,).
            u: speed of each rotor [rad/s].
        """
        return jax.vmap(self.field)(near[:, None], u[:, None])[:, 0]

    def write(self, x, u, share: Float[Array, " rotors *b"]) -> Float[Array, " 13 *b"]:
        """ẋ from the additional thrust of each rotor, as a share of k u².

        Args:
            share: of each rotor, as a share of k u² (rotors,).
        """
        vehicle = self.vehicle
        thrust = vehicle.thrust_coefficient * u * u * share
        x_moment, y_moment = (dot(arms, thrust) for arms in zip(*vehicle.rotor_positions, strict=True))
        acceleration = sum(thrust) / vehicle.mass * rotation.body_z(x[QUATERNION])
        torque = y_moment, -x_moment, jnp.zeros_like(x_moment)
        turning = jnp.stack([part / moment for part, moment in zip(torque, vehicle.inertia, strict=True)])
        still = jnp.zeros((VELOCITY.start, *turning.shape[1:]), turning.dtype)
        return jnp.concatenate([still, acceleration, turning])


def _up(x: Float[Array, " 13 *b"]) -> Float[Array, " 3 *b"]:
    """The world's up in the body frame, Rᵀe_z."""
    return rotation.body_z(rotation.conjugate(x[QUATERNION]))


def _nearness(x: Float[Array, " 13 *b"], up: Float[Array, " 3 *b"], vehicle: Vehicle) -> Float[Array, " rotors *b"]:
    """R / h of each rotor, its altitude h at least R / 2."""
    altitude = x[2]
    heights = jnp.stack([altitude + along * up[0] + across * up[1] for along, across in vehicle.rotor_positions])
    return vehicle.rotor_radius / jnp.maximum(heights, vehicle.rotor_radius / 2)
