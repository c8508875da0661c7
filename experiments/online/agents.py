"""Prediction models of the Iris, estimators that adapt them in the air, and the truth after each change."""

import math
from collections.abc import Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from experiments.flying.changes import DOUBLED_DRAG, LOST_THRUST, OFF_CENTRE_LOAD, WEAK_ROTOR, weak_rotor
from experiments.flying.plant import wind_force
from hybrid_jax.control import Hardware, Observer, advance
from hybrid_jax.control.observer import MOTION
from hybrid_jax.dynamics import ConstantDisturbance, Hybrid, with_disturbance
from hybrid_jax.dynamics.base import AbstractEstimator, AbstractVectorField, ravel_learned
from hybrid_jax.dynamics.rigid_body import corrected, rigid_body
from hybrid_jax.dynamics.terms import Terms, units_of
from hybrid_jax.online import Hypothesis, OnlineAdaptation
from hybrid_jax.rotation import body_z
from hybrid_jax.sim.domain import EXTERNAL_FORCE, PARAMETER_SHIFT, SOURCE, Domain
from hybrid_jax.sim.forces import DRAG_COEFFICIENT
from hybrid_jax.vehicle import IRIS, QUATERNION

CHANGES: Mapping[str, Domain] = {
    "parameter_shift": PARAMETER_SHIFT,
    "off_centre_load": OFF_CENTRE_LOAD,
    "external_force": EXTERNAL_FORCE,
    "weak_rotor": WEAK_ROTOR,
    "doubled_drag": DOUBLED_DRAG,
    "nothing": SOURCE,
}
CHANGE_NAMES = {
    "parameter_shift": "other inertia",
    "off_centre_load": "load of 20 % off centre",
    "external_force": "side wind",
    "weak_rotor": "one rotor 15 % weaker",
    "doubled_drag": "twice the drag",
    "nothing": "no change",
}
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
# Logarithms of inertia and efficiency, 1 cm or so of the arm, and half the vehicle's own drag or more.
PRIOR = {"Ix": 0.3, "Iy": 0.3, "Iz": 0.3, "centre_of_mass": 0.05, "efficiency": 0.2, "added_drag": 0.3}
DISTURBANCE = (3.0, 3.0, 3.0, 5.0, 5.0, 5.0)  # m/s², rad/s²
PROCESS = (0.0,) * 7 + (0.003,) * 3 + (0.005,) * 3  # m/s² and rad/s² of a white noise, √s
INERTIA = {"Ix": 0.3, "Iy": 0.3, "Iz": 0.3}
# One e-fold of mass, which the model does not have, is one less of all accelerations.
MASS = {"efficiency": -1.0, "Ix": -1.0, "Iy": -1.0, "Iz": -1.0, "added_drag": -DRAG_COEFFICIENT / IRIS.mass}
FORCES = ("disturbance[vx]", "disturbance[vy]", "disturbance[vz]")
HYPOTHESES = (
    Hypothesis("inertia", INERTIA),
    Hypothesis("load", INERTIA | {"centre_of_mass": 0.05}, ({name: 0.2 * size for name, size in MASS.items()},)),
    *(Hypothesis(f"rotor {i}", {f"efficiency[{i}]": 0.2}) for i in range(IRIS.rotors)),
    Hypothesis("drag", {"added_drag": 0.3}),
    Hypothesis("wind", dict.fromkeys(FORCES, 3.0), rates=dict.fromkeys(FORCES, 1.5), lead=0.1),
)


def nominal() -> AbstractVectorField:
    """The Iris with drag and without ground effect; inertia, centre of mass, efficiencies and drag may change."""
    body = rigid_body(IRIS, LEARNED, Terms(drag=(DRAG_COEFFICIENT, DRAG_COEFFICIENT, DRAG_COEFFICIENT)))
    return corrected(body, ("efficiency", "added_drag"))


def true_theta(domain: Domain) -> Float[np.ndarray, " 12"]:
    """Return `nominal`'s θ after a change; since its mass is fixed, another mass changes all other parameters."""
    vehicle, share = domain.vehicle, IRIS.mass / domain.vehicle.mass
    inertia = np.log(share * np.divide(vehicle.inertia, IRIS.inertia))
    centre = np.subtract(IRIS.rotor_positions, vehicle.rotor_positions)[0] / units_of(IRIS)["centre_of_mass"]
    efficiency = np.full(IRIS.rotors, math.log(share))
    if weak_rotor in domain.forces:
        efficiency[0] += math.log(1 - LOST_THRUST)
    drag = np.full(3, domain.drag_coefficient / vehicle.mass - DRAG_COEFFICIENT / IRIS.mass)
    return np.concatenate([inertia, drag, centre, efficiency])


def with_theta(theta: Float[Array | np.ndarray, " 12"]) -> AbstractVectorField:
    """Return `nominal` with other parameters, in the order of `true_theta`."""
    return ravel_learned(nominal())[1](jnp.asarray(theta, float))


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

    field: AbstractVectorField
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
        mixer = IRIS.mixer / np.array([IRIS.mass, *IRIS.inertia])[:, None]
        squares = jnp.square(u) + jnp.asarray(np.linalg.inv(mixer), u.dtype) @ accelerations
        return jnp.sqrt(jnp.clip(squares, 1.0, IRIS.max_rotor_speed**2))


def fixed_model(
    field: AbstractVectorField, period: float, clock: float, bandwidth: float = 0.0, share: float = 0.0
) -> FixedModel:
    numbers: list[Any] = [np.asarray(number, np.float32) for number in (bandwidth, share, clock)]
    return FixedModel(Observer(as_numpy(with_disturbance(field)), numbers[0], period), *numbers[1:])


def online(hardware: Hardware, period: float) -> OnlineAdaptation:
    sizes = np.maximum(hardware.sizes(), 1e-4)
    return OnlineAdaptation(
        nominal(), period, tuple(sizes.tolist()), PRIOR, DISTURBANCE, process=PROCESS, hypotheses=HYPOTHESES
    )


def as_numpy(tree):
    return jax.tree.map(lambda leaf: np.asarray(leaf) if eqx.is_array(leaf) else leaf, tree)
