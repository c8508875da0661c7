"""Residual networks on part of a multirotor's state, chosen by name: `multirotor_network`."""

from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from hybrid_jax import checks, rotation
from hybrid_jax.dynamics.base import AbstractVectorField, as_field, jvp_columns
from hybrid_jax.dynamics.composition import AbstractWrapper, Hybrid
from hybrid_jax.dynamics.equations import dot
from hybrid_jax.networks.mlp import LinearSkip, residual_network, zero_output
from hybrid_jax.networks.normalisation import AbstractScaling
from hybrid_jax.vehicle import BODY_RATES, IRIS, POSITION, QUATERNION, STATE_SIZE, VELOCITY, Vehicle

# Name → how many numbers the network reads besides u (and one of each rotor near the ground), or returns.
INPUTS = {"all": STATE_SIZE, "no_xy": STATE_SIZE - 2, "no_xy_yaw": 10, "near_ground": 10, "body": 10, "body_motion": 9}
OUTPUTS = {"all": STATE_SIZE, "accelerations": 6, "rotors": 6}
FROM_THE_BODY = ("body", "body_motion")


def _check(inputs: str, outputs: str, vehicle: Vehicle) -> None:
    for name, value, known in (("inputs", inputs, INPUTS), ("outputs", outputs, OUTPUTS)):
        if value not in known:
            raise ValueError(f"{name} must be one of {', '.join(known)}, got {value!r}")
    checks.instance("vehicle", vehicle, Vehicle)
    if inputs == "near_ground":
        checks.positive("vehicle.rotor_radius", vehicle.rotor_radius)


class View(AbstractWrapper):
    """A field that reads some features of a multirotor's state and returns some derivatives.

    Other derivatives are zero, because the physics ṗ = v and q̇ = ½ q ⊗ [0, ω] is exact. In the body frame it returns
    ṗ, v̇ and the quaternion r of q̇ = q ⊗ r, which makes it equivariant to yaw and to translation in x and y.
    """

    inputs: str = eqx.field(static=True, default="all")
    outputs: str = eqx.field(static=True, default="all")
    vehicle: Vehicle = eqx.field(static=True, default=IRIS)

    state_size: ClassVar[int] = STATE_SIZE
    input_size = property(lambda self: self.vehicle.rotors)

    def __check_init__(self):
        _check(self.inputs, self.outputs, self.vehicle)

    def read(self, x):
        if self.inputs in ("all", "no_xy"):
            return x if self.inputs == "all" else x[2:]
        up, height, rates = _up(x), x[2:3], x[BODY_RATES]
        if self.inputs not in FROM_THE_BODY:
            near = [_nearness(x, self.vehicle)] if self.inputs == "near_ground" else []
            return jnp.concatenate([height, *near, up, x[VELOCITY], rates])
        velocity = rotation.rotate(rotation.conjugate(x[QUATERNION]), x[VELOCITY])
        return jnp.concatenate([height, -up, velocity, rates] if self.inputs == "body" else [velocity, rates, up])

    def write(self, x, inside):
        zeros = jnp.zeros((STATE_SIZE - len(inside), *inside.shape[1:]), inside.dtype)
        inside = jnp.concatenate([zeros, inside]) if len(zeros) else inside
        if self.inputs not in FROM_THE_BODY:
            return inside
        q = x[QUATERNION]
        position, velocity = rotation.rotate(q, inside[POSITION]), rotation.rotate(q, inside[VELOCITY])
        return jnp.concatenate([position, rotation.multiply(q, inside[QUATERNION]), velocity, inside[BODY_RATES]])


def multirotor_network(
    vehicle: Vehicle,
    key: PRNGKeyArray,
    *,
    inputs: str = "all",
    outputs: str = "all",
    hidden: int = 64,
    norm: str = "batch",
    activation: str = "relu",
    scaling: AbstractScaling | None = None,
    linear: bool = False,
) -> AbstractVectorField:
    """Make a residual network that reads and returns parts of a multirotor's state; by default all of it (paper).

    Args:
        vehicle: the vehicle, for its number of rotors; "near_ground" and "rotors" need its geometry and rotor radius.
        inputs: what the network reads besides u: "all" of x; "no_xy", all except p_x and p_y; "no_xy_yaw", p_z, the
            up direction in the body frame Rᵀe_z, v and ω, so that a wind keeps its direction if the vehicle yaws;
            "near_ground", these and R / h of each rotor after p_z, in which ground effect is nearly linear (Cheeseman
            and Bennett 1955); "body", p_z, the direction of gravity and Rᵀv [m/s] in the body frame, and ω;
            "body_motion", Rᵀv, ω and Rᵀe_z, without the altitude, for flight away from the ground.
        outputs: "all" 13 derivatives; "accelerations", v̇ and ω̇; "rotors", these and the thrust of each rotor by a
            second network (`RotorThrust`), initially zero.
        hidden: number of hidden units of each network.
        norm: see `residual_network`.
        activation: see `residual_network`.
        scaling: see `residual_network`.
        linear: add a linear skip connection (`LinearSkip`); the output is then initially zero.

    Raises:
        ValueError: if a name is unknown, or there is no rotor radius.
    """
    _check(inputs, outputs, vehicle)
    rotors, writes = vehicle.rotors, OUTPUTS[outputs]
    reads = INPUTS[inputs] + rotors * (inputs == "near_ground")
    options: dict = {"hidden": hidden, "scaling": scaling, "activation": activation}
    network = residual_network(reads, rotors, key, norm=norm, outputs=writes, **options)
    field = zero_output(LinearSkip(jnp.zeros((writes, reads + rotors)), network)) if linear else network
    if (inputs, outputs) != ("all", "all"):
        field = View(field, inputs, outputs, vehicle)
    if outputs != "rotors":
        return field
    thrust = residual_network(1, 1, jax.random.fold_in(key, 1), norm="none", **options)
    return Hybrid(zero_output(RotorThrust(thrust, vehicle)), field)


class RotorThrust(AbstractVectorField):
    """v̇ and ω̇ of a thrust k uᵢ² f(R / hᵢ, uᵢ) of each rotor along the body's z axis, with nominal k and inertia.

    By dimensional analysis, the ground effect on a rotor in hover is a function of its radius R over its altitude h
    (Cheeseman and Bennett 1955). One network learns it from the data of all rotors; force and torque follow from the
    vehicle's geometry. The other derivatives are zero. The network must not have batch normalisation.
    """

    accepts_batch: ClassVar[bool] = True

    field: AbstractVectorField
    vehicle: Vehicle = eqx.field(static=True)

    def __check_init__(self):
        checks.positive("vehicle.rotor_radius", self.vehicle.rotor_radius)

    def __call__(self, x: Float[Array, " 13 *b"], u: Float[Array, " rotors *b"]) -> Float[Array, " 13 *b"]:
        return self.write(x, u, self.share(_nearness(x, self.vehicle), u))

    def fuse_for_inference(self):
        return RotorThrust(as_field(self.field).fuse_for_inference(), self.vehicle)

    def linearize(self, x, u, dx, du):
        """Differentiate the network twice for each rotor, for any number of directions."""
        near, d_near = jvp_columns(lambda x: _nearness(x, self.vehicle), (x,), (dx,))
        share, pullback = jax.vjp(self.share, near, u)
        by_near, by_u = pullback(jnp.ones_like(share))
        d_share = by_near[:, None] * d_near + by_u[:, None] * du
        return jvp_columns(self.write, (x, u, share), (dx, du, d_share))

    def share(self, near: Float[Array, " rotors *b"], u: Float[Array, " rotors *b"]) -> Float[Array, " rotors *b"]:
        """Return f of each rotor, for its R / h and its speed [rad/s]."""
        return jax.vmap(self.field)(near[:, None], u[:, None])[:, 0]

    def write(self, x, u, share: Float[Array, " rotors *b"]) -> Float[Array, " 13 *b"]:
        """Return ẋ from the additional thrust of each rotor as a fraction of k u²."""
        vehicle = self.vehicle
        thrust = vehicle.thrust_coefficient * u * u * share
        x_moment, y_moment = (dot(arms, thrust) for arms in zip(*vehicle.rotor_positions, strict=True))
        acceleration = sum(thrust) / vehicle.mass * rotation.body_z(x[QUATERNION])
        torque = y_moment, -x_moment, jnp.zeros_like(x_moment)
        turning = jnp.stack([part / moment for part, moment in zip(torque, vehicle.inertia, strict=True)])
        still = jnp.zeros((VELOCITY.start, *turning.shape[1:]), turning.dtype)
        return jnp.concatenate([still, acceleration, turning])


def _up(x: Float[Array, " 13 *b"]) -> Float[Array, " 3 *b"]:
    """Return the up direction in the body frame, Rᵀe_z."""
    return rotation.body_z(rotation.conjugate(x[QUATERNION]))


def _nearness(x: Float[Array, " 13 *b"], vehicle: Vehicle) -> Float[Array, " rotors *b"]:
    """Return R / h of each rotor, with its altitude h at least R / 2."""
    up = _up(x)
    heights = jnp.stack([x[2] + along * up[0] + across * up[1] for along, across in vehicle.rotor_positions])
    return vehicle.rotor_radius / jnp.maximum(heights, vehicle.rotor_radius / 2)
