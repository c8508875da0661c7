"""Prediction models of a vehicle, estimators that adapt them in the air, and the truth after each change."""

import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from experiments.flying.plant import wind_force
from experiments.online.worlds import body_of
from hybrid_jax.control import Hardware, Observer, advance
from hybrid_jax.control.observer import MOTION
from hybrid_jax.dynamics import ConstantDisturbance, Hybrid, with_disturbance
from hybrid_jax.dynamics.base import AbstractEstimator, AbstractVectorField, ravel_learned
from hybrid_jax.dynamics.rigid_body import RigidBody, corrected, rigid_body
from hybrid_jax.dynamics.terms import units_of
from hybrid_jax.online import Hypothesis, OnlineAdaptation
from hybrid_jax.rotation import body_z
from hybrid_jax.sim.forces import DRAG_COEFFICIENT
from hybrid_jax.vehicle import IRIS, QUATERNION

AGENTS = {
    "unadapted": "not adapted",
    "observer": "disturbance observer",
    "l1": "L1 adaptive augmentation",
    "least_squares": "least squares after 10 s on the ground",
    "online": "online adaptation",
    "oracle": "oracle",
}
LEARNED = ("Ix", "Iy", "Iz", "centre_of_mass")
NAMES = (  # of the entries of θ before the disturbance
    *("Ix", "Iy", "Iz", "drag x", "drag y", "drag z", "centre_of_mass x", "centre_of_mass y"),
    *(f"efficiency {i}" for i in range(4)),
)
PARTS = len(NAMES)
# Logarithms of inertia and efficiency, 1 cm or so of the Iris's arm; the same for all vehicles.
PRIOR = {"Ix": 0.3, "Iy": 0.3, "Iz": 0.3, "centre_of_mass": 0.05, "efficiency": 0.2}
DRAG = 0.3 / (DRAG_COEFFICIENT / IRIS.mass)  # of the vehicle's own drag
ACCELERATION, TURNING = 3.0, 5.0  # m/s², rad/s²: of the Iris; about as large a share of weight and weight times arm
INERTIA = {name: PRIOR[name] for name in ("Ix", "Iy", "Iz")}


def own_drag(world: str) -> Float[np.ndarray, "3"]:
    """Return a vehicle's drag along its axes before a change [1/s]."""
    return body_of(world).drag(body_of(world).vehicle)


def hypotheses(world: str) -> tuple[Hypothesis, ...]:
    # One e-fold of mass, which the model does not have, is one less of all accelerations.
    drag = {f"added_drag[{i}]": size for i, size in enumerate(own_drag(world).tolist())}
    mass = dict.fromkeys(("efficiency", *INERTIA), -0.2) | {name: -0.2 * size for name, size in drag.items()}
    forces = [f"disturbance[v{axis}]" for axis in "xyz"]
    return (
        Hypothesis("inertia", INERTIA),
        Hypothesis("load", INERTIA | {"centre_of_mass": PRIOR["centre_of_mass"]}, (mass,)),
        *(Hypothesis(f"rotor {i}", {f"efficiency[{i}]": PRIOR["efficiency"]}) for i in range(IRIS.rotors)),
        Hypothesis("drag", {name: DRAG * size for name, size in drag.items()}),
        Hypothesis("wind", dict.fromkeys(forces, ACCELERATION), rates=dict.fromkeys(forces, 1.5), lead=0.1),
    )


def nominal(world: str) -> RigidBody:
    """The vehicle without ground effect; its inertia, centre of mass, efficiencies and drag may change."""
    own = body_of(world)
    body = rigid_body(own.vehicle, LEARNED, own.terms)
    return corrected(body, ("efficiency", "added_drag"))  # type: ignore  # a rigid body as well


def true_theta(world: str, change: str) -> Float[np.ndarray, " 12"]:
    """Return `nominal`'s θ after a change; since its mass is fixed, another mass changes all other parameters."""
    known, truth = body_of(world), body_of(world, change)
    before, vehicle = known.vehicle, truth.vehicle
    share = before.mass / vehicle.mass
    inertia = np.log(share * np.divide(vehicle.inertia, before.inertia))
    centre = np.subtract(before.rotor_positions, vehicle.rotor_positions)[0] / units_of(before)["centre_of_mass"]
    efficiency = math.log(share) + np.log1p([-truth.lost, *[0.0] * (before.rotors - 1)])
    return np.concatenate([inertia, truth.drag(vehicle) - known.drag(vehicle), centre, efficiency])


def with_theta(world: str, theta: Float[Array | np.ndarray, " 12"]) -> AbstractVectorField:
    """Return `nominal` with other parameters, in the order of `true_theta`."""
    return ravel_learned(nominal(world))[1](jnp.asarray(theta, float))


class FixedModel(AbstractEstimator):
    """A model that does not learn: `observer` has bandwidth 0 for none, `share` is 1 if it includes the wind."""

    observer: Observer
    share: Float[Array, ""]
    clock: Float[Array, ""]

    def begin(self, x):
        return self.observer.begin(x), jnp.zeros((), x.dtype)

    def update(self, state, x, u):
        return self.observer.update(state[0], x, u), state[1] + self.observer.period

    def model(self, state):
        force = wind_force(self.clock + state[1])
        known = self.share * jnp.concatenate([force, jnp.zeros(3)]) / IRIS.mass
        return Hybrid(self.observer.field, ConstantDisturbance(state[0].disturbance + known))


class L1(AbstractEstimator):
    """L1 adaptive augmentation with a piecewise constant law and a predictor of v and ω (Hanover, Foehn, Sun, Kaufmann
    and Scaramuzza, "Performance, precision, and payloads: adaptive nonlinear MPC for quadrotors", 2021).
    """

    field: RigidBody
    gain: float = eqx.field(static=True)  # of the predictor [rad/s]
    cutoff: Float[Any, ""]  # of the filter [rad/s]
    period: float = eqx.field(static=True)

    def begin(self, x):
        return x, x[MOTION], jnp.zeros(4, x.dtype)

    def update(self, state, x, u):
        before, predicted, filtered = state
        kept = math.exp(-self.gain * self.period)
        error = predicted - before[MOTION]
        span = (1 - kept) / self.gain
        missing = -kept / span * error
        moved = advance(self.field, before, u, self.period)[MOTION]
        predicted = moved + kept * error + span * missing
        matched = jnp.concatenate([(missing[:3] @ body_z(before[QUATERNION]))[None], missing[3:]])
        filtered = filtered - jnp.expm1(-self.cutoff * self.period) * (matched - filtered)
        return x, predicted, filtered

    def model(self, state):
        return self.field

    def command(self, state, x, u):
        return self._added(u, -state[2])

    def effective(self, state, u):
        return self._added(u, state[2])

    def _added(self, u, accelerations):
        """Add these accelerations, along the thrust and about the three axes, to the speeds u."""
        vehicle = self.field.vehicle
        mixer = vehicle.mixer / np.array([vehicle.mass, *vehicle.inertia])[:, None]
        squares = jnp.square(u) + jnp.asarray(np.linalg.inv(mixer), u.dtype) @ accelerations
        return jnp.sqrt(jnp.clip(squares, 1.0, vehicle.max_rotor_speed**2))


def fixed_model(
    field: AbstractVectorField, period: float, clock: float, bandwidth: float = 0.0, share: float = 0.0
) -> FixedModel:
    numbers: list[Any] = [np.asarray(number, np.float32) for number in (bandwidth, share, clock)]
    return FixedModel(Observer(as_numpy(with_disturbance(field)), numbers[0], period), *numbers[1:])


def online(world: str, hardware: Hardware, period: float) -> OnlineAdaptation:
    # The angular acceleration of weight times arm, over that of the Iris.
    own, iris = (units_of(each)["aerodynamic_moment"] / each.inertia[0] for each in (body_of(world).vehicle, IRIS))
    sizes, turning = np.maximum(hardware.sizes(), 1e-4), own / iris
    prior = PRIOR | {f"added_drag[{i}]": DRAG * size for i, size in enumerate(own_drag(world).tolist())}
    disturbance = (ACCELERATION,) * 3 + (TURNING * turning,) * 3
    process = (0.0,) * 7 + (0.003,) * 3 + (0.005 * turning,) * 3  # m/s² and rad/s² of a white noise, √s
    options: Any = {"process": process, "hypotheses": hypotheses(world)}
    return OnlineAdaptation(nominal(world), period, tuple(sizes.tolist()), prior, disturbance, **options)


def as_numpy(tree):
    return jax.tree.map(lambda leaf: np.asarray(leaf) if eqx.is_array(leaf) else leaf, tree)
