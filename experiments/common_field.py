"""One vector field of which every model that learned is a special case, and that of the truth: two programs fly all."""

from dataclasses import asdict
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hybrid_jax import rotation
from hybrid_jax.disturbance import ConstantDisturbance
from hybrid_jax.features import Accelerations, NearGround, Placeless, TiltOnly, View, nearness
from hybrid_jax.normalisation import BatchNorm, Bias
from hybrid_jax.residual import InputScaling, LinearPath, ResidualNetwork
from hybrid_jax.rigid_body import ForcedBody, RigidBody, nominal, rigid_body
from hybrid_jax.sim.domain import Domain
from hybrid_jax.sim.forces import WIND_MEAN, drag, ground_effect, parameters_of, wind
from hybrid_jax.state import BODY_RATES, INPUT_SIZE, QUATERNION, STATE_SIZE, VELOCITY, Input, State
from hybrid_jax.vector_field import AbstractVectorField, Hybrid
from hybrid_jax.vehicle import Vehicle

UP_SIZE, ROTORS = 3, 4
NOW = 0.0  # s: forces that are known here do not change with time

Scalar = Float[Array, ""]


class CommonField(AbstractVectorField):
    """ẋ = s f_p(x, u) + f_d(x, Rᵀe_z, u), or f_d(x, Rᵀe_z, R / h of each rotor, u).

    Attributes:
        share: s, 1, or 0 for a network alone.
        body: f_p.
        network: f_d; reads the state and the direction of the world's up in the body. Its norm is a bias.
        feels_ground: whether it reads how near the rotors are to it as well.
    """

    share: Scalar
    body: RigidBody
    network: ResidualNetwork
    feels_ground: bool = eqx.field(static=True, default=False)

    def __call__(self, x: State, u: Input) -> State:
        up = rotation.body_z(rotation.conjugate(x[QUATERNION]))
        near = [nearness(x[2], up, self.body.vehicle)] if self.feels_ground else []
        return self.share * self.body(x, u) + self.network(jnp.concatenate([x, up, *near]), u)

    def described(self) -> dict[str, Any]:
        """What is the same for all lanes, as JSON values."""
        return {"vehicle": asdict(self.body.vehicle), "scaling": [*asdict(self.network.scaling).values()]}


class TrueField(AbstractVectorField):
    """ẋ = f_p(x, u) + (drag, ground effect, a steady force): the simulator's equations without a clock.

    Attributes:
        body: f_p.
        drag: [kg/s].
        push: steady force [N, world].
    """

    body: RigidBody
    drag: Scalar
    push: Float[Array, "3"]

    def __call__(self, x: State, u: Input) -> State:
        vehicle, theta = self.body.vehicle, self.body.theta()
        known = eqx.tree_at(lambda p: p.drag_coefficient, parameters_of(vehicle), self.drag)
        now = jnp.asarray(NOW, x.dtype)
        air, ground = drag(x, u, now, known), ground_effect(x, u, now, known)
        torque = rotation.rotate(rotation.conjugate(x[QUATERNION]), ground.torque)
        inertia = jnp.stack([theta["Ix"], theta["Iy"], jnp.asarray(vehicle.inertia[2], x.dtype)])
        force = air.force + ground.force + self.push
        still = jnp.zeros_like(x, shape=VELOCITY.start)
        return self.body(x, u) + jnp.concatenate([still, force / vehicle.mass, torque / inertia])

    def described(self) -> dict[str, Any]:
        """What is the same for all lanes, as JSON values."""
        return {"vehicle": asdict(self.body.vehicle)}


Believed = CommonField | TrueField  # by a controller


def common(field: AbstractVectorField, vehicle: Vehicle, hidden: int, scaling: InputScaling) -> CommonField:
    """A rigid body, a network or their hybrid, which may have a constant disturbance, in the common form.

    A single one, so map it over stacked ones.

    Args:
        hidden, scaling: of the network that a rigid body alone is given, which is silent.

    Raises:
        ValueError: a field of another kind, or a network whose norm is no affine map of a sample.
    """
    match field:
        case Hybrid(physics=Hybrid(physics=RigidBody() as body, residual=ConstantDisturbance() as steady)):
            share, network = 1.0, wide(field.residual)
            network = eqx.tree_at(lambda f: f.bias_out, network, network.bias_out + steady.of_all)
        case Hybrid(physics=RigidBody() as body):
            share, network = 1.0, wide(field.residual)
        case RigidBody() as body:
            share, network = 1.0, silent(hidden, STATE_SIZE + UP_SIZE, scaling)
        case _:
            share, network, body = 0.0, wide(field), rigid_body(vehicle)
    if isinstance(body, ForcedBody):
        network, body = _times(body.yielding(), network), RigidBody(body.log_ratios, body.vehicle)
    feels_ground = isinstance(getattr(field, "residual", field), NearGround)
    return CommonField(jnp.asarray(share), body, network, feels_ground)


def true_field(domain: Domain, vehicle: Vehicle) -> TrueField:
    """The true vehicle of a domain under its own forces, of the wind the mean: the best model without a clock.

    Args:
        vehicle: that of the models, from which the true one may differ in Ix, Iy and k.
    """
    truth = nominal(domain.vehicle)
    body = RigidBody({name: jnp.log(truth[name] / value) for name, value in nominal(vehicle).items()}, vehicle)
    push = jnp.array([0.0, WIND_MEAN if wind in domain.forces else 0.0, 0.0])
    return TrueField(body, jnp.asarray(domain.drag_coefficient), push)


def silent(hidden: int, reads: int, scaling: InputScaling) -> ResidualNetwork:
    """A network that reads so many numbers beside u and returns zero."""
    return ResidualNetwork(
        weight_in=jnp.zeros((hidden, reads + INPUT_SIZE)),
        norm=Bias(jnp.zeros(hidden)),
        weight_out=jnp.zeros((STATE_SIZE, hidden)),
        bias_out=jnp.zeros(STATE_SIZE),
        scaling=scaling,
    )


def wide(field: Any) -> ResidualNetwork:
    """The network in a view as one that reads [x, Rᵀe_z, u], or [x, Rᵀe_z, R / h, u], and writes all of ẋ, deployed.

    Raises:
        ValueError: as `common`.
    """
    columns, rows, reads = np.arange(STATE_SIZE), np.arange(STATE_SIZE), STATE_SIZE + UP_SIZE
    up = STATE_SIZE + np.arange(UP_SIZE)
    while isinstance(field, View):
        match field:
            case Placeless():
                columns = columns[2:]
            case TiltOnly():
                columns = np.concatenate([[2], up, columns[VELOCITY], columns[BODY_RATES]])
            case NearGround():
                near = reads + np.arange(ROTORS)
                columns = np.concatenate([[2], near, up, columns[VELOCITY], columns[BODY_RATES]])
                reads += ROTORS
            case Accelerations():
                rows = rows[VELOCITY.start :]
            case _:
                raise ValueError(f"--residual-inputs: a network behind {type(field).__name__} cannot be flown here")
        field = field.field
    network = _bent(field) if isinstance(field, LinearPath) else field
    if not isinstance(network, ResidualNetwork):
        raise ValueError(f"a model must be a rigid body, a network or a hybrid of these, got {type(field).__name__}")
    weight, shift = _affine(network)
    empty = silent(len(shift), reads, network.scaling)
    columns = np.concatenate([columns, reads + np.arange(INPUT_SIZE)])
    return ResidualNetwork(
        weight_in=empty.weight_in.at[:, columns].set(weight),
        norm=Bias(shift),
        weight_out=empty.weight_out.at[rows].set(network.weight_out),
        bias_out=empty.bias_out.at[rows].set(network.bias_out),
        scaling=network.scaling,
    )


def _times(factors: Float[Array, " d"], network: ResidualNetwork) -> ResidualNetwork:
    """The network with each number that it returns times its factor."""
    scaled = factors[:, None] * network.weight_out, factors * network.bias_out
    return eqx.tree_at(lambda n: (n.weight_out, n.bias_out), network, scaled)


def _bent(path: LinearPath) -> ResidualNetwork:
    """The same map as a network alone: a line is two units, z = relu(z) − relu(−z)."""
    weight, shift = _affine(path.field)
    straight = jnp.eye(weight.shape[1])
    return ResidualNetwork(
        weight_in=jnp.concatenate([weight, straight, -straight]),
        norm=Bias(jnp.concatenate([shift, jnp.zeros(2 * len(straight))])),
        weight_out=jnp.concatenate([path.field.weight_out, path.weight, -path.weight], axis=1),
        bias_out=path.field.bias_out,
        scaling=path.field.scaling,
    )


def _affine(network: ResidualNetwork) -> tuple[Float[Array, "h m"], Float[Array, " h"]]:
    match network.norm:
        case BatchNorm():
            return network.norm.fold(network.weight_in)
        case Bias():
            return network.weight_in, network.norm.shift
    raise ValueError(f"--norm: a network with {type(network.norm).__name__} cannot be flown here, only batch or none")
