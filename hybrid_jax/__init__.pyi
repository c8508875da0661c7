"""The names of `hybrid_jax` and where they are, for type checkers and for __init__.py."""

from . import runtime
from ._version import __version__
from .adaptation import (
    METHODS,
    Adaptation,
    FineTune,
    LeastSquares,
    Method,
    Ridge,
    Solution,
    Source,
    adapt,
    adapt_records,
    pool,
)
from .dynamics import (
    AbstractVectorField,
    Actuator,
    Diffusion,
    Frozen,
    Grid,
    Hybrid,
    RigidBody,
    StateSpaceModel,
    actuated,
    check_grid,
    diffusion,
    rigid_body,
    with_disturbance,
    with_hidden,
)
from .estimation import (
    covariance_of,
    estimate_windows,
    fit_disturbance,
    fit_least_squares,
    fit_records,
    intervals,
    observe,
    predict,
    simulate,
)
from .flights import load_log, load_windows
from .integrate import RK4, SOLVERS, rollout, rollout_batch
from .io import Model, check_savable, load, portable, save
from .networks import grid_network, residual_network
from .networks.standardise import with_scaling
from .online import ExtendedKalmanFilter, Hypothesis, OnlineAdaptation
from .planning import Excitation, FlightBounds, InputBounds, excitation
from .records import Record
from .training import Settings, Stage, fit, fit_gauss_newton, fit_in_stages, rates_by_group
from .trajectories import Trajectories
from .vehicle import IRIS, Vehicle, load_vehicle

__all__ = ["Trajectories", "__version__", "runtime"]
__all__ += ["AbstractVectorField", "Frozen", "Hybrid", "with_disturbance"]
__all__ += ["IRIS", "RigidBody", "Vehicle", "load_vehicle", "rigid_body"]
__all__ += ["Actuator", "actuated"]
__all__ += ["Diffusion", "Grid", "check_grid", "diffusion", "fit_gauss_newton", "grid_network"]
__all__ += ["RK4", "SOLVERS", "residual_network", "rollout", "rollout_batch", "with_scaling"]
__all__ += ["Model", "check_savable", "load", "portable", "save"]
__all__ += ["Settings", "Stage", "fit", "fit_in_stages", "rates_by_group"]
__all__ += ["METHODS", "Adaptation", "FineTune", "LeastSquares", "Method", "Ridge", "Solution", "Source", "adapt"]
__all__ += ["Excitation", "FlightBounds", "InputBounds", "excitation"]
__all__ += ["ExtendedKalmanFilter", "Hypothesis", "OnlineAdaptation"]
__all__ += ["covariance_of", "fit_least_squares", "intervals", "load_log", "load_windows", "pool"]
__all__ += ["Record", "StateSpaceModel", "estimate_windows", "fit_records", "predict", "simulate", "with_hidden"]
__all__ += ["adapt_records", "fit_disturbance", "observe"]
