"""Programs compiled on other threads, while flights are being flown or another model is being trained."""

from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import AbstractContextManager

import jax
import numpy as np

from hybrid_jax.runtime import cores
from hybrid_jax.sim.flight import DT
from hybrid_jax.sim.record import SplitSpec
from hybrid_jax.state import INPUT_SIZE, QUATERNION, STATE_SIZE
from hybrid_jax.trajectories import Trajectories


class Ahead(AbstractContextManager):
    """Jobs by name that compile, in the order in which they are given, one for each core at a time.

    Processes of a distributed run compile as they go: threads of theirs would not meet in one order.
    """

    def __init__(self, jobs: Mapping[str, Callable[[], None]]):
        self._pool = ThreadPoolExecutor(cores())
        alone = jax.process_count() == 1
        self._jobs: dict[str, Future] = {name: self._pool.submit(job) for name, job in jobs.items() if alone}

    def wait_for(self, name: str) -> None:
        """Wait until a job is done, if there is one of this name. What it failed with, the caller will meet himself."""
        if name in self._jobs:
            wait([self._jobs[name]])

    def __exit__(self, *exception) -> None:
        self._pool.shutdown(cancel_futures=True)


def blank(spec: SplitSpec) -> Trajectories:
    """Windows of the shapes of a split that has yet to be flown; the vehicle rests."""
    x = np.zeros((spec.windows, spec.steps, STATE_SIZE), np.float32)
    x[..., QUATERNION] = [1, 0, 0, 0]
    return Trajectories(x[:, 0], np.zeros((*x.shape[:2], INPUT_SIZE), np.float32), x, dt=DT)
