"""What is timed: models and training runs with the paper's settings, and synthetic flights of the Iris near hover."""

from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from hybrid_jax.dynamics.base import AbstractVectorField
from hybrid_jax.dynamics.composition import Hybrid
from hybrid_jax.dynamics.rigid_body import perturbed, rigid_body
from hybrid_jax.integrate import rollout_batch
from hybrid_jax.networks.mlp import InputScaling, residual_network
from hybrid_jax.sweep.lanes import lane, stack
from hybrid_jax.training import fitting
from hybrid_jax.training.fitting import FitState, RunConfig, make_run_config
from hybrid_jax.training.loss import REGULARISERS
from hybrid_jax.training.objective import Settings
from hybrid_jax.trajectories import Trajectories
from hybrid_jax.vehicle import IRIS

Model = Literal["hybrid", "no_physics", "physics_only"]
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


def training_runs(
    model: Model, runs: int, windows: int, max_epochs: int = 2000, hidden: int = 64
) -> tuple[FitState, RunConfig]:
    """Stacked initial states and configurations of runs on so many windows, with the paper's rates (paper, App. A)."""

    def begin(seed):
        return fitting.start(untrained(model, seed, hidden), jax.random.key(seed))

    physics, network = 1e-2, 1e-4
    rates: Any = {"hybrid": Hybrid(physics, network), "no_physics": network, "physics_only": physics}[model]  # pyright: ignore[reportArgumentType]
    plan = make_run_config(rates, np.arange(windows), windows, 100, 20, max_epochs, 1e-3)
    return jax.device_get(eqx.filter_jit(eqx.filter_vmap(begin))(jnp.arange(runs))), stack([plan] * runs)


def training_run(model: Model, windows: int, hidden: int = 64) -> tuple[FitState, RunConfig]:
    """One of them."""
    return lane(training_runs(model, 1, windows, hidden=hidden), 0)


def make_flights(count: int, steps: int) -> tuple[np.ndarray, np.ndarray]:
    """Tilted and turning initial states (n, 13), and rotor speeds (n, t, 4) near hover."""
    rng = np.random.default_rng(0)
    x0 = rng.normal(scale=0.3, size=(count, 13))
    x0[:, 2:4] = 2.0, 1.0
    x0[:, 3:7] /= np.linalg.norm(x0[:, 3:7], axis=1, keepdims=True)
    return x0, IRIS.hover_speed * rng.uniform(0.95, 1.05, size=(count, steps, 4))


def make_windows(count: int, steps: int) -> Trajectories:
    """The same in float32, simulated by the rigid body with nominal parameters."""
    x0, u = (part.astype(np.float32) for part in make_flights(count, steps))
    x = jax.jit(lambda x0, u: rollout_batch(rigid_body(IRIS), x0, u, DT))(x0, u)
    return Trajectories(x0, u, np.asarray(x), DT)
