"""The simulator's equations as a prediction model: what a controller can know at best of the vehicle in a domain."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from hybrid_jax import rotation
from hybrid_jax.dynamics.base import AbstractVectorField
from hybrid_jax.dynamics.rigid_body import RigidBody, nominal
from hybrid_jax.io import portable
from hybrid_jax.sim.domain import Domain
from hybrid_jax.sim.forces import WIND_MEAN, drag, ground_effect, parameters_of, wind
from hybrid_jax.state import QUATERNION, VELOCITY, Input, State
from hybrid_jax.vehicle import Vehicle


@portable
class TrueField(AbstractVectorField):
    """ẋ = f_p(x, u) + (drag, ground effect, a constant force)."""

    body: RigidBody  # f_p
    drag: Float[Array, ""]  # coefficient [kg/s]
    push: Float[Array, "3"]  # constant force [N, world]

    def __call__(self, x: State, u: Input) -> State:
        vehicle, theta = self.body.vehicle, self.body.theta()
        known = eqx.tree_at(lambda p: p.drag_coefficient, parameters_of(vehicle), self.drag)
        now = jnp.zeros((), x.dtype)  # neither force depends on time
        air, ground = drag(x, u, now, known), ground_effect(x, u, now, known)
        torque = rotation.rotate(rotation.conjugate(x[QUATERNION]), ground.torque)
        inertia = jnp.stack([theta["Ix"], theta["Iy"], jnp.asarray(vehicle.inertia[2], x.dtype)])
        force = air.force + ground.force + self.push
        still = jnp.zeros_like(x, shape=VELOCITY.start)
        return self.body(x, u) + jnp.concatenate([still, force / vehicle.mass, torque / inertia])


def true_field(domain: Domain, vehicle: Vehicle) -> TrueField:
    """The true vehicle of a domain under its forces, of the wind only the mean; `vehicle` is that of the models."""
    truth = nominal(domain.vehicle)
    body = RigidBody({name: jnp.log(truth[name] / value) for name, value in nominal(vehicle).items()}, vehicle)
    push = jnp.array([0.0, WIND_MEAN if wind in domain.forces else 0.0, 0.0])
    return TrueField(body, jnp.asarray(domain.drag_coefficient), push)
