"""What is timed: the models of the paper's protocol, and made-up flights of the Iris near hover."""

from dataclasses import replace

import jax
import numpy as np

from experiments.paper.conditions import fresh_fields
from experiments.paper.config import PAPER, AdaptationConfig, Model
from hybrid_jax.dynamics.base import AbstractVectorField
from hybrid_jax.dynamics.rigid_body import rigid_body
from hybrid_jax.integrate import rollout_batch
from hybrid_jax.sweep.lanes import lane
from hybrid_jax.trajectories import Trajectories
from hybrid_jax.vehicle import IRIS

DT = 0.01  # s


def protocol(lanes: int, windows: int) -> AdaptationConfig:
    """The paper's protocol with so many seeds, and so many windows to pre-train on."""
    return replace(PAPER, seeds=lanes, source_train=windows)


def untrained(model: Model) -> AbstractVectorField:
    """A fresh model of the paper's size."""
    return lane(fresh_fields(model, IRIS, protocol(1, PAPER.source_train)), 0)


def make_flights(count: int, steps: int) -> tuple[np.ndarray, np.ndarray]:
    """Starting states (n, 13) that tilt and turn, and rotor speeds (n, t, 4) near hover."""
    rng = np.random.default_rng(0)
    x0 = rng.normal(scale=0.3, size=(count, 13))
    x0[:, 2:4] = 2.0, 1.0
    x0[:, 3:7] /= np.linalg.norm(x0[:, 3:7], axis=1, keepdims=True)
    return x0, IRIS.hover_speed * rng.uniform(0.95, 1.05, size=(count, steps, 4))


def make_windows(count: int, steps: int) -> Trajectories:
    """These flights, in float32, as the rigid body with nominal parameters flies them."""
    x0, u = (part.astype(np.float32) for part in make_flights(count, steps))
    x = jax.jit(lambda x0, u: rollout_batch(rigid_body(IRIS), x0, u, DT))(x0, u)
    return Trajectories(x0, u, np.asarray(x), DT)
