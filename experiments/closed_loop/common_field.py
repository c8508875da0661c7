"""One vector field of which every model that learned is a special case, and that of the truth: few programs fly all."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from hybrid_jax import rotation
from hybrid_jax.dynamics.base import (
    AbstractVectorField,
    Hybrid,
    apply_residual,
    fuse_for_inference,
    jvp_columns,
    linearize,
)
from hybrid_jax.dynamics.disturbance import ConstantDisturbance
from hybrid_jax.dynamics.rigid_body import RigidBody, nominal, rigid_body
from hybrid_jax.io.structure import portable
from hybrid_jax.networks.mlp import InputScaling, ResidualNetwork
from hybrid_jax.networks.normalisation import Bias
from hybrid_jax.sim.domain import Domain
from hybrid_jax.sim.forces import WIND_MEAN, drag, ground_effect, parameters_of, wind
from hybrid_jax.state import INPUT_SIZE, QUATERNION, STATE_SIZE, VELOCITY, Input, State
from hybrid_jax.vehicle import Vehicle

NOW = 0.0  # s: forces that are known here do not change with time

Scalar = Float[Array, ""]


@portable
class CommonField(AbstractVectorField):
    """ẋ = s f_p(x, u) + (d + f_d(x, u) as f_p takes it up).

    Attributes:
        share: s, 1, or 0 for a network alone.
        body: f_p.
        steady: d.
        residual: f_d, `deployed`.
    """

    share: Scalar
    body: RigidBody
    steady: ConstantDisturbance
    residual: AbstractVectorField

    def __call__(self, x: State, u: Input) -> State:
        return self.share * self.body(x, u) + self.acting(x, self.residual(x, u))

    def acting(self, x: State, residual: State) -> State:
        """What of ẋ is not f_p, from what the residual returned."""
        return apply_residual(self.body, x, self.steady.of_all + residual)


@linearize.register
def _(field: CommonField, x, u, dx, du):
    alone, slope = linearize(field.body, x, u, dx, du)
    more = linearize(field.residual, x, u, dx, du)
    added, further = jvp_columns(field.acting, (x, more[0]), (dx, more[1]))
    return field.share * alone + added, field.share * slope + further


@portable
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


Believed = CommonField | TrueField  # by a controller


def common(field: AbstractVectorField, vehicle: Vehicle, hidden: int, scaling: InputScaling) -> CommonField:
    """A rigid body, its hybrid, which may have a constant disturbance, or else a field alone, in the common form.

    A single one, so map it over stacked ones.

    Args:
        hidden, scaling: of the network that a rigid body alone is given, which is silent.
    """
    share, steady = 1.0, ConstantDisturbance(jnp.zeros(STATE_SIZE - VELOCITY.start))
    match field:
        case Hybrid(physics=Hybrid(physics=RigidBody() as body, residual=ConstantDisturbance() as steady)):
            residual = field.residual
        case Hybrid(physics=RigidBody() as body):
            residual = field.residual
        case RigidBody() as body:
            residual = silent(hidden, scaling)
        case _:
            share, residual, body = 0.0, field, rigid_body(vehicle)
    return CommonField(jnp.asarray(share), body, steady, fuse_for_inference(residual))


def true_field(domain: Domain, vehicle: Vehicle) -> TrueField:
    """The true vehicle of a domain under its own forces, of the wind the mean: the best model without a clock.

    Args:
        vehicle: that of the models, from which the true one may differ in Ix, Iy and k.
    """
    truth = nominal(domain.vehicle)
    body = RigidBody({name: jnp.log(truth[name] / value) for name, value in nominal(vehicle).items()}, vehicle)
    push = jnp.array([0.0, WIND_MEAN if wind in domain.forces else 0.0, 0.0])
    return TrueField(body, jnp.asarray(domain.drag_coefficient), push)


def silent(hidden: int, scaling: InputScaling) -> ResidualNetwork:
    """A network that returns zero."""
    return ResidualNetwork(
        weight_in=jnp.zeros((hidden, STATE_SIZE + INPUT_SIZE)),
        norm=Bias(jnp.zeros(hidden)),
        weight_out=jnp.zeros((STATE_SIZE, hidden)),
        bias_out=jnp.zeros(STATE_SIZE),
        scaling=scaling,
    )
