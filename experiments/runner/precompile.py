"""Compile programs on other threads, while flights are simulated or another model is trained."""

from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import AbstractContextManager

import jax
import numpy as np

from hybrid_jax.runtime import cores
from hybrid_jax.sim.flight import DT, SplitSpec
from hybrid_jax.state import INPUT_SIZE, QUATERNION, STATE_SIZE
from hybrid_jax.trajectories import Trajectories


class PrecompilePool(AbstractContextManager):
    """Named compile jobs, started in the order given, one per core at a time.

    A distributed run ignores them: its processes must compile collective programs in the same order.
    """

    def __init__(self, jobs: Mapping[str, Callable[[], object]]):
        self._pool = ThreadPoolExecutor(cores())
        alone = jax.process_count() == 1
        self._jobs: dict[str, Future] = {name: self._pool.submit(job) for name, job in jobs.items() if alone}

    def wait_for(self, name: str) -> None:
        """Wait for a job, if there is one of this name. Its error is ignored: the caller will run into it too."""
        if name in self._jobs:
            wait([self._jobs[name]])

    def __exit__(self, *exception) -> None:
        self._pool.shutdown(cancel_futures=True)


def placeholder(spec: SplitSpec) -> Trajectories:
    """Windows at rest with the shapes of a split that is not yet simulated."""
    x = np.zeros((spec.windows, spec.steps, STATE_SIZE), np.float32)
    x[..., QUATERNION] = [1, 0, 0, 0]
    return Trajectories(x[:, 0], np.zeros((*x.shape[:2], INPUT_SIZE), np.float32), x, dt=DT)
