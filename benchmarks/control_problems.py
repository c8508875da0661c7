"""Six optimal control problems of 20 × 0.05 s, and trained models to solve them with.

The cost is that of `Controller`: weighted deviations from a reference, and changes of the rotor speeds.
"""

from dataclasses import dataclass
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

import hybrid_jax as hj
from benchmarks.subjects import DT, SCALING
from hybrid_jax import rotation
from hybrid_jax.control import Controller, figure_eight, hover, low_flyby, sample, step
from hybrid_jax.control.references import Path
from hybrid_jax.dynamics import AbstractVectorField, ConstantDisturbance, Terms
from hybrid_jax.networks import multirotor_network
from hybrid_jax.rotation import from_axis_angle
from hybrid_jax.trajectories import Trajectories

CONTROLLER = Controller(hj.IRIS)
WIND = (3.0, -1.0, 0.5, 0.0, 0.0, 0.0)  # m/s², rad/s²


@dataclass(frozen=True)
class Problem:
    """Where it begins, where it shall be at the end of each interval, and an acceleration that the model is given."""

    x0: Float[np.ndarray, "13"]
    reference: Float[np.ndarray, "20 13"]
    wind: Float[np.ndarray, "6"]


@cache
def problems() -> dict[str, Problem]:
    """The problems by name."""

    def hop(t):
        return jnp.stack([0 * t, 0 * t, 1 + 0.5 * jnp.sin(jnp.pi * t) ** 2]), 0 * t

    return {
        "hop": _problem(hop),
        "figure-8 window": _problem(figure_eight(6.0), start=0.5, off=(0.3, 0.3, 0.3)),
        "flip recovery": _problem(hover((0.0, 0.0, 3.0)), turn=2.5),
        "low pass": _problem(low_flyby(3.0, every=2.5), start=0.75, off=(0.0, 0.2, 0.1)),
        "wind hover": _problem(hover(), off=(0.2, 0.0, 0.0), wind=WIND),
        "step": _problem(step((1.0, -0.5, 0.5), at=0.0, yaw=0.5), begin=hover()),
    }


def _problem(path: Path, *, start=0.0, off=(0.0, 0.0, 0.0), turn=0.0, wind=(0.0,) * 6, begin: Path | None = None):
    """Along a path from its state at `start` [s], or that of `begin`, moved by `off` [m] and rolled by `turn` [rad]."""
    first = round(start / CONTROLLER.period)
    states = sample(path, CONTROLLER, start + CONTROLLER.period)
    x0 = states[first] if begin is None else sample(begin, CONTROLLER, CONTROLLER.period)[0]
    rolled = rotation.multiply(from_axis_angle(jnp.array([1.0, 0.0, 0.0]), jnp.asarray(turn)), x0[3:7])
    x0 = x0.at[:3].add(jnp.array(off)).at[3:7].set(rolled)
    return Problem(*(np.asarray(part, float) for part in (x0, CONTROLLER.horizon(states, first), wind)))


VEHICLE = hj.rigid_body(hj.IRIS, (), Terms(drag=(0.5, 0.5, 0.2)))  # the truth: physics of a model has no drag


def trained(activation: str, epochs: int, hidden: int = 64, **options) -> AbstractVectorField:
    """A hybrid of rigid body and network, trained on flights of `VEHICLE`."""
    key, windows = jax.random.key(0), flights(VEHICLE, 1200, seed=0)
    network = multirotor_network(hj.IRIS, key, hidden=hidden, scaling=SCALING, activation=activation, **options)
    model = hj.Hybrid(hj.rigid_body(hj.IRIS), network)
    rates = hj.Hybrid(1e-2, 1e-3)  # pyright: ignore[reportArgumentType]
    return hj.fit(model, windows[:1000], windows[1000:], key, rates=rates, max_epochs=epochs, min_epochs=1).best


def adapted(model: AbstractVectorField) -> AbstractVectorField:
    """The model after least squares on flights of `VEHICLE` with 1.2 times the inertia, in a wind."""
    other = hj.Hybrid(
        hj.rigid_body(hj.IRIS, ("Ix", "Iy"), VEHICLE.terms),
        ConstantDisturbance(jnp.array([1.5, 0.5, 0.0, 0.0, 0.0, 0.0])),
    )
    heavier = jax.tree.map(lambda log_ratio: log_ratio + np.log(1.2), other.physics)
    other = hj.Hybrid(heavier, other.residual)
    return hj.adapt(model, flights(other, 200, seed=1), method="least_squares").field


def flights(vehicle: AbstractVectorField, count: int, seed: int, steps: int = 10) -> Trajectories:
    """Windows of a vehicle from random tilted and turning states."""
    rng = np.random.default_rng(seed)
    position = rng.uniform(-1, 1, (count, 3)) * [2, 2, 1] + [0, 0, 2]
    turned = [1, 0, 0, 0] + rng.normal(size=(count, 4)) * [0, 0.3, 0.3, 0.3]
    x0 = np.concatenate([position, turned, rng.normal(scale=1.5, size=(count, 6))], axis=1)
    x0[:, 3:7] /= np.linalg.norm(x0[:, 3:7], axis=1, keepdims=True)
    u = hj.IRIS.hover_speed * rng.uniform(0.6, 1.3, (count, 1, 4)) * rng.uniform(0.9, 1.1, (count, steps, 4))
    x0, u = x0.astype(np.float32), u.astype(np.float32)
    return Trajectories(x0, u, np.asarray(jax.jit(lambda x0, u: hj.rollout_batch(vehicle, x0, u, DT))(x0, u)), DT)
