"""Hybrid models of vehicles: ẋ = f_p(x, u; θ_p) + f_d(x, u; θ_d), learned from flight, adapted from seconds of it.

Imports point down; simulator and learning meet in `experiments` only. From the bottom:

- state, rotation, vehicle, trajectories: what flies, and its windows.
- vector_field, rigid_body, multirotor, disturbance, baselines: ẋ = f(x, u).
- residual, normalisation, normalised_layer, rotors, features: the network in it.
- rollout, loss, metrics, channels, objective, preparation, training, schedule: one training run as a pure function.
- least_squares, uncertainty, linear_adaptation, expert_augmentation: other ways to adapt, and how sure θ_p is.
- hosts, lanes, sweep: every seed, size and rate a lane of one compiled program, on all devices of all hosts.
- models, datasets, archive, files: what is kept.
- rows, summary, paired, claims, report, standings, ablations, closed_loop_* and the figures: what is told.
- sim: the MuJoCo MJX quadrotor, its forces and its pilot.
- flights: recorded flights, read, checked and cleaned.
- control: closed-loop flight with any field: controller, references, disturbance observer.
- export: any field and its steps as StableHLO in a file and as CasADi functions.
"""

from hybrid_jax import runtime
from hybrid_jax.dynamics.base import AbstractVectorField, Hybrid
from hybrid_jax.dynamics.rigid_body import RigidBody, rigid_body
from hybrid_jax.flights.windows import load_windows
from hybrid_jax.integrate import RK4, rollout, rollout_batch
from hybrid_jax.io.models import Model, load, save
from hybrid_jax.networks.mlp import residual_network
from hybrid_jax.training.fitting import fit
from hybrid_jax.training.objective import Settings
from hybrid_jax.trajectories import Trajectories
from hybrid_jax.vehicle import IRIS, Vehicle, load_vehicle

__all__ = [
    "IRIS",
    "RK4",
    "AbstractVectorField",
    "Hybrid",
    "Model",
    "RigidBody",
    "Settings",
    "Trajectories",
    "Vehicle",
    "fit",
    "load",
    "load_vehicle",
    "load_windows",
    "residual_network",
    "rigid_body",
    "rollout",
    "rollout_batch",
    "runtime",
    "save",
]
