"""Vector fields ẋ = f(x, u): the physics of a multirotor, grids, hybrids, disturbances and hidden states."""

from hybrid_jax.dynamics.actuators import Actuated, Actuator, SampledRotors, actuated, rotor_speeds
from hybrid_jax.dynamics.base import AbstractEstimator, AbstractVectorField, HoldState, trainable
from hybrid_jax.dynamics.composition import Frozen, Hybrid, unfreeze
from hybrid_jax.dynamics.disturbance import ConstantDisturbance, with_disturbance
from hybrid_jax.dynamics.grids import Diffusion, Grid, check_grid, diffusion
from hybrid_jax.dynamics.hidden import DisturbanceModel, Lag, LinearDynamics, Oscillator, RandomWalk, with_hidden
from hybrid_jax.dynamics.outputs import StateSpaceModel
from hybrid_jax.dynamics.rigid_body import FrozenRates, RigidBody, rigid_body
from hybrid_jax.dynamics.terms import Terms
from hybrid_jax.dynamics.vehicle_file import VehicleModel, load_vehicle_model

__all__ = ["AbstractVectorField", "Frozen", "FrozenRates", "HoldState", "Hybrid", "trainable", "unfreeze"]
__all__ += ["Actuated", "Actuator", "Diffusion", "Grid", "actuated", "check_grid", "diffusion", "rotor_speeds"]
__all__ += ["AbstractEstimator", "ConstantDisturbance", "DisturbanceModel", "with_disturbance"]
__all__ += ["RigidBody", "Terms", "VehicleModel", "load_vehicle_model", "rigid_body"]
__all__ += ["Lag", "LinearDynamics", "Oscillator", "RandomWalk", "SampledRotors", "with_hidden"]
__all__ += ["StateSpaceModel"]
