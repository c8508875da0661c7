"""Thrust of each rotor beyond k u², by one network that all rotors share.

Near the ground the rotors have more thrust, and those that are nearer have most: a force and a torque at once. The
vehicle's geometry says where each thrust acts, so that data of every rotor train the same function.
"""

from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from hybrid_jax import checks, rotation
from hybrid_jax.dynamics.base import AbstractVectorField, fuse_for_inference, jvp_columns
from hybrid_jax.dynamics.equations import dot
from hybrid_jax.state import QUATERNION, VELOCITY
from hybrid_jax.vehicle import Vehicle


class RotorThrust(AbstractVectorField):
    """v̇ and ω̇ of a thrust k uᵢ² f(R / hᵢ, uᵢ) of each rotor along the body's z axis, k and inertia the nominal ones.

    By dimensional analysis, the ground effect on a rotor in hover is a function of its radius R over its altitude h
    (Cheeseman and Bennett 1955). That function is learned. The other derivatives are exactly zero.

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

    def __call__(self, x: Float[Array, " 13 *b"], u: Float[Array, " 4 *b"]) -> Float[Array, " 13 *b"]:
        return self.write(x, u, self.share(self.read(x), u))

    def fuse_for_inference(self):
        return RotorThrust(fuse_for_inference(self.field), self.vehicle)

    def linearize(self, x, u, dx, du):
        """Two derivatives of the network for each rotor, whatever the number of directions."""
        near, d_near = jvp_columns(self.read, (x,), (dx,))
        share, pullback = jax.vjp(self.share, near, u)
        by_near, by_u = pullback(jnp.ones_like(share))
        d_share = by_near[:, None] * d_near + by_u[:, None] * du
        return jvp_columns(self.write, (x, u, share), (dx, du, d_share))

    def read(self, x: Float[Array, " 13 *b"]) -> Float[Array, " 4 *b"]:
        """R / h of each rotor."""
        return nearness(x[2], rotation.body_z(rotation.conjugate(x[QUATERNION])), self.vehicle)

    def share(self, near: Float[Array, " 4 *b"], u: Float[Array, " 4 *b"]) -> Float[Array, " 4 *b"]:
        """f of each rotor."""
        return jax.vmap(self.field)(near[:, None], u[:, None])[:, 0]

    def write(self, x, u, share: Float[Array, " 4 *b"]) -> Float[Array, " 13 *b"]:
        """ẋ from the additional thrust of each rotor, as a share of k u²."""
        vehicle = self.vehicle
        thrust = vehicle.thrust_coefficient * u * u * share
        x_moment, y_moment = (dot(arms, thrust) for arms in zip(*vehicle.rotor_positions, strict=True))
        acceleration = sum(thrust) / vehicle.mass * rotation.body_z(x[QUATERNION])
        torque = y_moment, -x_moment, jnp.zeros_like(x_moment)
        turning = jnp.stack([part / moment for part, moment in zip(torque, vehicle.inertia, strict=True)])
        still = jnp.zeros((VELOCITY.start, *turning.shape[1:]), turning.dtype)
        return jnp.concatenate([still, acceleration, turning])


def nearness(altitude: Float[Array, "*b"], up: Float[Array, " 3 *b"], vehicle: Vehicle) -> Float[Array, " 4 *b"]:
    """R / h of each rotor, h at least R / 2, from the body's altitude [m] and the world's up in the body frame."""
    heights = jnp.stack([altitude + x * up[0] + y * up[1] for x, y in vehicle.rotor_positions])
    return vehicle.rotor_radius / jnp.maximum(heights, vehicle.rotor_radius / 2)
