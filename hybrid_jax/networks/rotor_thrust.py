"""What each rotor pushes more than k u²: one network that all of them share, at places that are known.

Near the ground a rotor pushes more, and more on the side that is nearer: a force and a torque at once. Learned of the
rotor, where it acts is told by the vehicle, and every rotor's flight teaches all four.
"""

import equinox as eqx
import jax
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
)
from hybrid_jax.state import QUATERNION, VELOCITY
from hybrid_jax.vehicle import Vehicle


class RotorThrust(AbstractVectorField):
    """v̇ and ω̇ of a thrust k uᵢ² f(R / hᵢ, uᵢ) of each rotor along the body's z axis, k and inertia the nominal ones.

    By dimension, the share by which the ground changes a rotor's thrust in hover is a function of its radius R over its
    altitude h (Cheeseman and Bennett 1955); which one is learned. The other derivatives are exactly zero.

    The code reads x[0], x[1], …, so x (13,) and u (4,) may carry trailing batch axes.

    Attributes:
        field: f, of one state and one input; a batch means nothing to it, and it returns one number.
        vehicle: whose rotors they are.

    Raises:
        ValueError: nothing is known of the rotors' radius.
    """

    field: AbstractVectorField
    vehicle: Vehicle = eqx.field(static=True)

    def __check_init__(self):
        checks.positive("vehicle.rotor_radius", self.vehicle.rotor_radius)

    def __call__(self, x: Float[Array, " 13 *b"], u: Float[Array, " 4 *b"]) -> Float[Array, " 13 *b"]:
        return self.write(x, u, self.share(self.read(x), u))

    def read(self, x: Float[Array, " 13 *b"]) -> Float[Array, " 4 *b"]:
        """R / h of each rotor."""
        return nearness(x[2], rotation.body_z(rotation.conjugate(x[QUATERNION])), self.vehicle)

    def share(self, near: Float[Array, " 4 *b"], u: Float[Array, " 4 *b"]) -> Float[Array, " 4 *b"]:
        """f of each rotor."""
        return jax.vmap(self.field)(near[:, None], u[:, None])[:, 0]

    def write(
        self, x: Float[Array, " 13 *b"], u: Float[Array, " 4 *b"], share: Float[Array, " 4 *b"]
    ) -> Float[Array, " 13 *b"]:
        """ẋ from the share of k u² that each rotor pushes more."""
        vehicle = self.vehicle
        thrust = vehicle.thrust_coefficient * u * u * share
        torque_x, torque_y = (
            sum(arm * one for arm, one in zip(arms, thrust, strict=True))
            for arms in zip(*((y, -x) for x, y in vehicle.rotor_positions), strict=True)
        )
        acceleration = sum(thrust) / vehicle.mass * rotation.body_z(x[QUATERNION])
        turning = jnp.stack([torque_x / vehicle.inertia[0], torque_y / vehicle.inertia[1], jnp.zeros_like(torque_x)])
        still = jnp.zeros((VELOCITY.start, *turning.shape[1:]), turning.dtype)
        return jnp.concatenate([still, acceleration, turning])


def nearness(altitude: Float[Array, "*b"], up: Float[Array, " 3 *b"], vehicle: Vehicle) -> Float[Array, " 4 *b"]:
    """R / h of each rotor, h at least R / 2: nothing is flown below.

    Args:
        altitude: of the body [m].
        up: the direction of the world's up in the body.
    """
    heights = jnp.stack([altitude + x * up[0] + y * up[1] for x, y in vehicle.rotor_positions])
    return vehicle.rotor_radius / jnp.maximum(heights, vehicle.rotor_radius / 2)


@train_batch.register(RotorThrust)
@infer_batch.register(RotorThrust)
def _(field, x, u):
    return field(x, u)


@fuse_for_inference.register
def _(field: RotorThrust):
    return RotorThrust(fuse_for_inference(field.field), field.vehicle)


@linearize.register
def _(field: RotorThrust, x, u, dx, du):
    """Each rotor asks the network for two derivatives, whatever the number of directions."""
    near, nearing = jvp_columns(field.read, (x,), (dx,))
    share, pulled = jax.vjp(field.share, near, u)
    by_near, by_u = pulled(jnp.ones_like(share))
    sharing = by_near[:, None] * nearing + by_u[:, None] * du
    return jvp_columns(field.write, (x, u, share), (dx, du, sharing))
