"""`make_residual`: a residual network for a multirotor by the names of its inputs and outputs."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import PRNGKeyArray

from hybrid_jax.dynamics.base import AbstractVectorField
from hybrid_jax.dynamics.composition import Hybrid
from hybrid_jax.networks import views
from hybrid_jax.networks.mlp import LinearSkip, residual_network, zero_output
from hybrid_jax.networks.normalisation import AbstractScaling
from hybrid_jax.state import INPUT_SIZE, STATE_SIZE
from hybrid_jax.vehicle import Vehicle

Wrapper = Callable[..., AbstractVectorField]

# Name → number of features that the network reads besides u, or of outputs, and the view around it if any.
INPUTS: dict[str, tuple[int, Wrapper | None]] = {
    "all": (STATE_SIZE, None),
    "no_xy": (STATE_SIZE - 2, views.DropXY),
    "no_xy_yaw": (10, views.DropXYYaw),
    "near_ground": (14, views.GroundDistance),
    "body": (10, views.BodyFrame),
    "body_motion": (9, views.BodyMotion),
}
OUTPUTS: dict[str, tuple[int, Wrapper | None]] = {
    "all": (STATE_SIZE, None),
    "accelerations": (6, views.Accelerations),
    "rotors": (6, views.Accelerations),
    "angular_acceleration": (3, views.Accelerations),
    "motion": (12, views.Motion),
}
FROM_THE_BODY = ("body", "body_motion")
OF_ROTORS = ("near_ground", "rotors")
# Outputs → the inputs that they go with, where these are not all.
GO_WITH = {"motion": FROM_THE_BODY}


def make_residual(
    key: PRNGKeyArray,
    *,
    inputs: str = "all",
    outputs: str = "all",
    hidden: int = 64,
    norm: str = "batch",
    activation: str = "relu",
    scaling: AbstractScaling | None = None,
    linear: bool = False,
    vehicle: Vehicle | None = None,
) -> AbstractVectorField:
    """A residual network that reads and returns part of a multirotor's state; by default all of it (paper).

    Args:
        scaling: as in `residual_network`.
        inputs: "all" of x; "no_xy", without p_x and p_y (`DropXY`); "no_xy_yaw", also without yaw (`DropXYYaw`);
            "near_ground", that and the rotors' distance to the ground (`GroundDistance`); "body", in the body frame
            (`BodyFrame`); "body_motion", that without the height (`BodyMotion`).
        outputs: "all" 13 derivatives; "accelerations", v̇ and ω̇; "rotors", these and the thrust of each rotor by a
            second network (`RotorThrust`), which starts at zero; "angular_acceleration", ω̇ alone; "motion", v̇ and ω̇
            and corrections of ṗ and q̇ (`Motion`).
        hidden: units of each network.
        norm: as in `residual_network`.
        activation: as in `residual_network`.
        linear: add a linear skip connection (`LinearSkip`); the output then starts at zero.
        vehicle: gives the number of rotors, by default four; needed by "near_ground" and "rotors".

    Raises:
        ValueError: an unknown name, outputs that do not go with the inputs (see `GO_WITH`), or no vehicle where one is
            needed.
    """
    for name, value, known in (("inputs", inputs, INPUTS), ("outputs", outputs, OUTPUTS)):
        if value not in known:
            raise ValueError(f"{name} must be one of {', '.join(known)}, got {value!r}")
    if inputs not in (needed := GO_WITH.get(outputs, tuple(INPUTS))):
        raise ValueError(f"outputs {outputs!r} needs inputs of {' or '.join(needed)}, got {inputs!r}")
    (reads, seen), (writes, written) = INPUTS[inputs], OUTPUTS[outputs]
    if vehicle is None and (needing := [name for name in (inputs, outputs) if name in OF_ROTORS]):
        raise ValueError(f"{needing[0]!r} needs the vehicle whose rotors feel the ground, got None")
    rotors = INPUT_SIZE if vehicle is None else vehicle.rotors
    options: dict = {"hidden": hidden, "scaling": scaling, "activation": activation}
    network = residual_network(reads, rotors, key, norm=norm, outputs=writes, **options)
    field = zero_output(LinearSkip(jnp.zeros((writes, reads + rotors)), network)) if linear else network
    field = field if written is None else written(field)
    if seen is not None:
        field = seen(field, vehicle) if seen is views.GroundDistance else seen(field)
    if vehicle is None or outputs != "rotors":
        return field
    thrust = residual_network(1, 1, jax.random.fold_in(key, 1), norm="none", **options)
    return Hybrid(zero_output(views.RotorThrust(thrust, vehicle)), field)
