"""What is timed: models and training runs with the paper's settings, and synthetic flights of the Iris near hover."""

from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from hybrid_jax.dynamics import AbstractVectorField, Grid, Hybrid, Terms, diffusion
from hybrid_jax.dynamics.rigid_body import perturbed, rigid_body
from hybrid_jax.integrate import rollout_batch
from hybrid_jax.networks.grids import grid_network
from hybrid_jax.networks.mlp import InputScaling, residual_network
from hybrid_jax.training import Settings, fitting
from hybrid_jax.training.fitting import RunConfig, make_run_config
from hybrid_jax.training.loss import REGULARISERS
from hybrid_jax.trajectories import Trajectories
from hybrid_jax.vehicle import IRIS

Model = Literal["hybrid", "no_physics", "physics_only"]
SUBJECTS = "paper", "vehicle", "pendulum", "car", "pde"
DT = 0.01  # s
BATCH = 100
SETTINGS = Settings(BATCH, REGULARISERS["trajectory_correlation"])
SCALING = InputScaling(IRIS.hover_speed, IRIS.hover_speed / 10)


def untrained(model: Model, seed: int | jax.Array = 0, hidden: int = 64) -> AbstractVectorField:
    """A model before training, by default of the paper's size."""
    physics_key, network_key = jax.random.split(jax.random.key(seed))
    physics = perturbed(IRIS, physics_key, low=0.8, high=1.25)
    network = residual_network(13, 4, network_key, hidden=hidden, scaling=SCALING)
    return {"hybrid": Hybrid(physics, network), "no_physics": network, "physics_only": physics}[model]


class Pendulum(AbstractVectorField):
    """README's: x = (angle [rad], rate [rad/s]), u = (acceleration [rad/s²],)."""

    log_length: Array

    def __call__(self, x, u):
        return jnp.stack([x[1], u[0] - 9.81 / jnp.exp(self.log_length) * jnp.sin(x[0])])


class Car(AbstractVectorField):
    """A single-track car: x = (X, Y, yaw, v_x, v_y, yaw rate), u = (steering [rad], acceleration [m/s²])."""

    log_front: Array  # of the cornering stiffness over the nominal one
    log_rear: Array

    def __call__(self, x, u):
        _, _, yaw, v, side, rate = x
        mass, inertia, front, rear, stiffness = 1500.0, 2500.0, 1.2, 1.6, 8e4
        ahead = stiffness * jnp.exp(self.log_front) * (u[0] - jnp.arctan2(side + front * rate, v))
        behind = -stiffness * jnp.exp(self.log_rear) * jnp.arctan2(side - rear * rate, v)
        moving = [v * jnp.cos(yaw) - side * jnp.sin(yaw), v * jnp.sin(yaw) + side * jnp.cos(yaw), rate]
        along = u[1] - ahead * jnp.sin(u[0]) / mass + side * rate
        across = (ahead * jnp.cos(u[0]) + behind) / mass - v * rate
        return jnp.stack([*moving, along, across, (front * ahead * jnp.cos(u[0]) - rear * behind) / inertia])


def subject(name: str, windows: int, intervals: int) -> tuple[Any, Any, RunConfig, Trajectories]:
    """The arguments of a gradient step of one of SUBJECTS: a hybrid, Adam's state, a plan and windows."""
    rng, key, zero = np.random.default_rng(0), jax.random.key(0), jnp.zeros(())
    x0, u = make_flights(windows, intervals)
    if name == "pendulum":
        physics, d, m, hidden = Pendulum(zero), 2, 1, 16
        x0, u = rng.normal(size=(windows, d)), rng.normal(size=(windows, intervals, m))
    elif name == "car":
        physics, d, m, hidden = Car(zero, zero), 6, 2, 16
        x0, u = rng.normal(size=(windows, d)), 0.1 * rng.normal(size=(windows, intervals, m))
        x0[:, 3] += 15
    else:
        learn = ("Ix", "Iy", "k", "drag")  # as a vehicle file has by default, and drag
        physics, d, m, hidden = rigid_body(IRIS, learn, Terms(drag=(0.3, 0.3, 0.2))), 13, 4, 32
    scaling = SCALING if name == "vehicle" else InputScaling()
    network = residual_network(d, m, key, hidden=hidden, norm="none", activation="tanh", scaling=scaling)
    field: Any = Hybrid(physics, network)
    if name == "paper":
        field = untrained("hybrid")
    elif name == "pde":
        grid = Grid((32,), 1 / 32, 2)
        field = Hybrid(diffusion(grid, (1e-3, 5e-3)), grid_network(grid, 0, key, kernel=3, hidden=8))
        x0, u = rng.random((windows, grid.size)), np.zeros((windows, intervals, 0))
    x0, u = x0.astype(np.float32), u.astype(np.float32)
    x = np.asarray(jax.jit(rollout_batch)(field, x0, u, DT))
    x = x + 0.01 * rng.normal(size=x.shape).astype(np.float32)
    rates: Any = Hybrid(1e-2, 1e-4)  # pyright: ignore[reportArgumentType]
    plan = make_run_config(rates, np.arange(windows), windows, 100, 20, 2000, 1e-3)
    return field, fitting.start(field, key).adam, plan, Trajectories(x0, u, x, DT)


def make_flights(count: int, steps: int) -> tuple[np.ndarray, np.ndarray]:
    """Tilted and turning initial states (n, 13), and rotor speeds (n, t, 4) near hover."""
    rng = np.random.default_rng(0)
    x0 = rng.normal(scale=0.3, size=(count, 13))
    x0[:, 2:4] = 2.0, 1.0
    x0[:, 3:7] /= np.linalg.norm(x0[:, 3:7], axis=1, keepdims=True)
    return x0, IRIS.hover_speed * rng.uniform(0.95, 1.05, size=(count, steps, 4))
