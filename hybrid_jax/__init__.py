"""Hybrid models of dynamical systems, ẋ = f_p(x, u; θ_p) + f_d(x, u; θ_d), adapted from seconds of new data.

    source = hj.fit(hj.Hybrid(physics, hj.residual_network(d, m, key)), train, validation, key)
    result = hj.adapt(source.best, windows)
    hj.save("model.npz", result.field)

The packages from the bottom up: `dynamics` (vector fields, physics), `networks` (residuals), `io` (models and data as
files), `training` (`fit`), `adaptation` (`adapt`), `sweep` (many runs as one program), `sim` (a MuJoCo quadrotor),
`flights` (recorded logs), `control` (closed-loop flight), `export` (StableHLO, CasADi, C), `identification` (a vehicle
from commands and measurements).
"""

from importlib.metadata import PackageNotFoundError, version

from hybrid_jax import runtime
from hybrid_jax.adaptation import (
    METHODS,
    Adaptation,
    Cause,
    FineTune,
    LeastSquares,
    Method,
    OnlineAdaptation,
    Ridge,
    Solution,
    Source,
    adapt,
    covariance_of,
    fit_least_squares,
    intervals,
    pool,
)
from hybrid_jax.dynamics import (
    AbstractVectorField,
    Actuator,
    Diffusion,
    Frozen,
    Grid,
    Hybrid,
    Multirotor,
    RigidBody,
    actuated,
    check_grid,
    diffusion,
    multirotor,
    rigid_body,
    with_disturbance,
)
from hybrid_jax.flights import load_log, load_windows
from hybrid_jax.identification import Excitation, FlightBounds, InputBounds, excitation
from hybrid_jax.integrate import RK4, SOLVERS, rollout, rollout_batch
from hybrid_jax.io import Model, check_savable, load, portable, save
from hybrid_jax.networks import grid_network, residual_network
from hybrid_jax.networks.standardise import with_scaling
from hybrid_jax.training import Settings, Stage, fit, fit_gauss_newton, fit_in_stages, rates_by_group
from hybrid_jax.trajectories import Trajectories
from hybrid_jax.vehicle import IRIS, Vehicle, load_vehicle

try:
    __version__ = version("hybrid_jax")
except PackageNotFoundError:  # a checkout that is not installed
    __version__ = "0+unknown"

__all__ = ["Trajectories", "__version__", "runtime"]
__all__ += ["AbstractVectorField", "Frozen", "Hybrid", "with_disturbance"]
__all__ += ["IRIS", "Multirotor", "RigidBody", "Vehicle", "load_vehicle", "multirotor", "rigid_body"]
__all__ += ["Actuator", "actuated"]
__all__ += ["Diffusion", "Grid", "check_grid", "diffusion", "fit_gauss_newton", "grid_network"]
__all__ += ["RK4", "SOLVERS", "residual_network", "rollout", "rollout_batch", "with_scaling"]
__all__ += ["Model", "check_savable", "load", "portable", "save"]
__all__ += ["Settings", "Stage", "fit", "fit_in_stages", "rates_by_group"]
__all__ += ["METHODS", "Adaptation", "FineTune", "LeastSquares", "Method", "Ridge", "Solution", "Source", "adapt"]
__all__ += ["Cause", "Excitation", "FlightBounds", "InputBounds", "OnlineAdaptation", "excitation"]
__all__ += ["covariance_of", "fit_least_squares", "intervals", "load_log", "load_windows", "pool"]
