"""What a multirotor's residual may read of the state and what it may write: views around any network.

A view is a vector field that hands features of x to the field inside and turns its answer into ẋ. Views nest: the outer
one chooses what is read, the inner one what is written. What is not read cannot be overfitted: drag knows no place, and
neither drag nor ground effect knows north. What is not written stays physics: ṗ = v and q̇ = ½ q ⊗ [0, ω] are exact;
in a log, where an estimator's p and v disagree, or a gyro has a bias, they need not be (see `Motion`).

The code reads x[0], x[1], …, so x (13,) and u (4,) may carry trailing batch axes.
"""

from abc import abstractmethod
from collections.abc import Callable
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from hybrid_jax import checks, rotation
from hybrid_jax.dynamics.base import (
    AbstractVectorField,
    Hybrid,
    fuse_for_inference,
    infer_batch,
    jvp_columns,
    linearize,
    train_batch,
    update_running_stats,
)
from hybrid_jax.networks.mlp import LinearSkip, residual_network, zero_output
from hybrid_jax.networks.rotor_thrust import RotorThrust, nearness
from hybrid_jax.networks.scaling import AbstractScaling
from hybrid_jax.state import BODY_RATES, INPUT_SIZE, POSITION, QUATERNION, STATE_SIZE, VELOCITY
from hybrid_jax.vehicle import Vehicle

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


class DropXY(View):
    """Blind to p_x and p_y: the field inside reads [p_z, q, v, ω] (11)."""

    field: AbstractVectorField

    def read(self, x):
        return x[2:]

    def write(self, x, inside):
        return inside


class DropXYYaw(View):
    """Blind to p_x, p_y and yaw, in the axes of the world: a wind keeps its direction, whichever way the nose points.

    The field inside reads p_z [m], the direction of the world's up in the body, Rᵀe_z (3), the velocity [m/s, world]
    and the body rates [rad/s] (10); what it returns is ẋ as it stands.
    """

    field: AbstractVectorField

    def read(self, x):
        up = rotation.body_z(rotation.conjugate(x[QUATERNION]))
        return jnp.concatenate([x[2:3], up, x[VELOCITY], x[BODY_RATES]])

    def write(self, x, inside):
        return inside


class GroundDistance(View):
    """`DropXYYaw` that also feels the ground: after p_z the field inside reads R / h of each rotor (14).

    What the ground does to a rotor falls with its altitude h over its radius R (Cheeseman and Bennett 1955): in R / h
    it is nearly a line, in p_z a cliff, which moves as the vehicle tilts.

    Attributes:
        vehicle: whose rotors they are.

    Raises:
        ValueError: nothing is known of the rotors' radius.
    """

    field: AbstractVectorField
    vehicle: Vehicle = eqx.field(static=True)

    def __check_init__(self):
        checks.positive("vehicle.rotor_radius", self.vehicle.rotor_radius)

    def read(self, x):
        up = rotation.body_z(rotation.conjugate(x[QUATERNION]))
        return jnp.concatenate([x[2:3], nearness(x[2], up, self.vehicle), up, x[VELOCITY], x[BODY_RATES]])

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
        return _to_world(x[QUATERNION], inside)


class BodyMotion(View):
    """Blind to p and yaw: `BodyFrame` without the height, for flight away from the ground.

    The field inside reads the velocity Rᵀv [m/s], the body rates [rad/s] and the direction of the world's up Rᵀe_z (9).
    """

    field: AbstractVectorField

    def read(self, x):
        to_body = rotation.conjugate(x[QUATERNION])
        return jnp.concatenate([rotation.rotate(to_body, x[VELOCITY]), x[BODY_RATES], rotation.body_z(to_body)])

    def write(self, x, inside):
        return _to_world(x[QUATERNION], inside)


def _to_world(q: Float[Array, " 4 *b"], inside: Features) -> Float[Array, " 13 *b"]:
    return jnp.concatenate(
        [
            rotation.rotate(q, inside[POSITION]),
            rotation.multiply(q, inside[QUATERNION]),
            rotation.rotate(q, inside[VELOCITY]),
            inside[BODY_RATES],
        ]
    )


class Accelerations(View):
    """The field inside returns v̇ and ω̇ (6), or ω̇ alone (3); the derivatives before them are exactly zero."""

    field: AbstractVectorField

    def read(self, x):
        return x

    def write(self, x, inside):
        return jnp.concatenate([jnp.zeros((STATE_SIZE - len(inside), *inside.shape[1:]), inside.dtype), inside])


class Motion(View):
    """The field inside returns corrections of ṗ, of the body rates that turn q, and v̇ and ω̇ (12), seen from the body.

    Only inside a view that turns it into the world: there r = ½ [0, δω], so that |q| stays 1.
    """

    field: AbstractVectorField

    def read(self, x):
        return x

    def write(self, x, inside):
        turning = jnp.concatenate([jnp.zeros((1, *inside.shape[1:]), inside.dtype), inside[3:6] / 2])
        return jnp.concatenate([inside[:3], turning, inside[6:]])


@train_batch.register
def _(field: View, x, u):
    return field.write(x, train_batch(field.field, field.read(x), u))


@infer_batch.register
def _(field: View, x, u):
    return field.write(x, infer_batch(field.field, field.read(x), u))


@fuse_for_inference.register
def _(field: View):
    return eqx.tree_at(lambda view: view.field, field, fuse_for_inference(field.field))


@linearize.register
def _(field: View, x, u, dx, du):
    seen, seeing = jvp_columns(field.read, (x,), (dx,))
    inside, moving = linearize(field.field, seen, u, seeing, du)
    return jvp_columns(field.write, (x, inside), (dx, moving))


@update_running_stats.register
def _(field: View, x, u):
    return eqx.tree_at(lambda view: view.field, field, update_running_stats(field.field, field.read(x), u))


def _as_it_is(field: AbstractVectorField) -> AbstractVectorField:
    return field


Wrapper = Callable[..., AbstractVectorField]

# Name → how many numbers the network reads beside u, or returns, and the view around it.
INPUTS: dict[str, tuple[int, Wrapper]] = {
    "all": (STATE_SIZE, _as_it_is),
    "no_xy": (STATE_SIZE - 2, DropXY),
    "no_xy_yaw": (10, DropXYYaw),
    "near_ground": (14, GroundDistance),
    "body": (10, BodyFrame),
    "body_motion": (9, BodyMotion),
}
OUTPUTS: dict[str, tuple[int, Wrapper]] = {
    "all": (STATE_SIZE, _as_it_is),
    "accelerations": (6, Accelerations),
    "rotors": (6, Accelerations),
    "angular_acceleration": (3, Accelerations),
    "motion": (12, Motion),
}
FROM_THE_BODY = ("body", "body_motion")
OF_ROTORS = ("near_ground", "rotors")
# Outputs → the inputs that they go with, where these are not all.
GO_WITH = {"motion": FROM_THE_BODY}


def restricted(
    key: PRNGKeyArray,
    *,
    inputs: str = "all",
    outputs: str = "all",
    hidden: int = 64,
    norm: str = "batch",
    scaling: AbstractScaling | None = None,
    linear: bool = False,
    vehicle: Vehicle | None = None,
) -> AbstractVectorField:
    """A network that reads and writes only part of a multirotor's state; by default all of it, as the paper's.

    Args:
        inputs: "all" of x; "no_xy", without p_x and p_y; "no_xy_yaw", without yaw as well (see `DropXYYaw`);
            "near_ground", that and how near the rotors are to it (see `GroundDistance`); "body", seen from the body
            (see `BodyFrame`); "body_motion", that without the height.
        outputs: "all" 13 derivatives; the "accelerations" v̇ and ω̇; "rotors", these beside the thrust of each rotor by
            a network of its own (`RotorThrust`), silent until it has learned; the "angular_acceleration" ω̇ alone;
            "motion", v̇ and ω̇ with ṗ and body rates as well (`Motion`).
        hidden: units of each network.
        norm: as in `residual_network`.
        linear: a linear map goes past the hidden layer (see `LinearSkip`), and both are silent until they have learned.
        vehicle: which "near_ground" and "rotors" need, and nothing else.

    Raises:
        ValueError: another name, outputs that do not go with the inputs (see `GO_WITH`), or "near_ground" or "rotors"
            of an unknown vehicle.
    """
    for name, value, known in (("inputs", inputs, INPUTS), ("outputs", outputs, OUTPUTS)):
        if value not in known:
            raise ValueError(f"{name} must be one of {', '.join(known)}, got {value!r}")
    if inputs not in (needed := GO_WITH.get(outputs, tuple(INPUTS))):
        raise ValueError(f"outputs {outputs!r} needs inputs of {' or '.join(needed)}, got {inputs!r}")
    (reads, seen), (writes, written) = INPUTS[inputs], OUTPUTS[outputs]
    if vehicle is None and (needing := [name for name in (inputs, outputs) if name in OF_ROTORS]):
        raise ValueError(f"{needing[0]!r} needs the vehicle whose rotors feel the ground, got None")
    network = residual_network(reads, INPUT_SIZE, key, hidden=hidden, scaling=scaling, norm=norm, outputs=writes)
    both = zero_output(LinearSkip(jnp.zeros((writes, reads + INPUT_SIZE)), network)) if linear else network
    seeing = partial(seen, vehicle=vehicle) if seen is GroundDistance else seen
    view = seeing(written(both))
    return Hybrid(_rotor_thrust(key, hidden, scaling, vehicle), view) if outputs == "rotors" else view


def _rotor_thrust(key: PRNGKeyArray, hidden: int, scaling: AbstractScaling | None, vehicle: Vehicle | None):
    assert vehicle is not None
    network = residual_network(1, 1, jax.random.fold_in(key, 1), hidden=hidden, scaling=scaling, norm="none")
    return zero_output(RotorThrust(network, vehicle))
