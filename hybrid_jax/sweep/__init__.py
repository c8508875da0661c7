"""Train many models as one compiled program, on all devices of all processes."""

from hybrid_jax.sweep.lanes import LaneMap, lane, stack
from hybrid_jax.sweep.training import Progress, evaluate, sweep

__all__ = ["LaneMap", "Progress", "evaluate", "lane", "stack", "sweep"]
