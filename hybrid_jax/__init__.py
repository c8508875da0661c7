"""Hybrid models of dynamical systems, ẋ = f_p(x, u; θ_p) + f_d(x, u; θ_d), adapted from seconds of new data.

    source = hj.fit(hj.Hybrid(physics, hj.residual_network(d, m, key)), train, validation, key)
    result = hj.adapt(source.best, windows)
    hj.save("model.npz", result.field)

Packages, each importing only those before it:

- dynamics: vector fields ẋ = f(x, u), the physics of multirotors, disturbances, baselines.
- networks: residual networks, their scaling and normalisation, and what they read and return.
- io: models, datasets and archives as files.
- training: `fit`, losses, learning-rate groups and stages.
- adaptation: `adapt` and its methods, least squares, confidence intervals.
- sweep: many training runs as one compiled program, on all devices of all hosts.
- sim: a MuJoCo MJX quadrotor with drag, ground effect and wind.
- flights: recorded flights, read, checked and cut into windows.
- control: closed-loop flight with any field as the prediction model.
- export: fields and their steps as StableHLO and as CasADi functions.
"""

from importlib.metadata import PackageNotFoundError, version

from hybrid_jax import runtime
from hybrid_jax.adaptation import (
    METHODS,
    Adaptation,
    FineTune,
    LeastSquares,
    Method,
    Ridge,
    Solution,
    Source,
    adapt,
    covariance_of,
    fit_least_squares,
    intervals,
)
from hybrid_jax.dynamics import (
    AbstractVectorField,
    Frozen,
    Hybrid,
    Multirotor,
    RigidBody,
    multirotor,
    rigid_body,
    with_disturbance,
)
from hybrid_jax.flights import load_log, load_windows
from hybrid_jax.integrate import RK4, SOLVERS, rollout, rollout_batch
from hybrid_jax.io import Model, check_savable, load, portable, save
from hybrid_jax.networks import residual_network
from hybrid_jax.networks.standardise import with_scaling
from hybrid_jax.training import Settings, Stage, fit, fit_in_stages, rates_by_group
from hybrid_jax.trajectories import Trajectories
from hybrid_jax.vehicle import IRIS, Vehicle, load_vehicle

try:
    __version__ = version("hybrid_jax")
except PackageNotFoundError:  # a checkout that is not installed
    __version__ = "0+unknown"

__all__ = [
    "IRIS",
    "METHODS",
    "RK4",
    "SOLVERS",
    "AbstractVectorField",
    "Adaptation",
    "FineTune",
    "Frozen",
    "Hybrid",
    "LeastSquares",
    "Method",
    "Model",
    "Multirotor",
    "Ridge",
    "RigidBody",
    "Settings",
    "Solution",
    "Source",
    "Stage",
    "Trajectories",
    "Vehicle",
    "__version__",
    "adapt",
    "check_savable",
    "covariance_of",
    "fit",
    "fit_in_stages",
    "fit_least_squares",
    "intervals",
    "load",
    "load_log",
    "load_vehicle",
    "load_windows",
    "multirotor",
    "portable",
    "rates_by_group",
    "residual_network",
    "rigid_body",
    "rollout",
    "rollout_batch",
    "runtime",
    "save",
    "with_disturbance",
    "with_scaling",
]
