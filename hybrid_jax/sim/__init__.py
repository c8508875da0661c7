"""A simulated quadrotor in MuJoCo MJX with drag, ground effect and wind, and a pilot for random flights."""

from hybrid_jax.sim.domain import EXTERNAL_FORCE, PARAMETER_SHIFT, SOURCE, Domain, Quadrotor
from hybrid_jax.sim.flight import Flights, SplitSpec, gone_wrong, make_dataset, random_flights

__all__ = [
    "EXTERNAL_FORCE",
    "PARAMETER_SHIFT",
    "SOURCE",
    "Domain",
    "Flights",
    "Quadrotor",
    "SplitSpec",
    "gone_wrong",
    "make_dataset",
    "random_flights",
]
