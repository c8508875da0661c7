"""The simulator's laws are tested in its own precision, and each program is compiled once for all tests."""

import jax
import numpy as np
import pytest

from hybrid_jax.sim.domain import SOURCE, Quadrotor
from hybrid_jax.sim.flight import SplitSpec, make_dataset


@pytest.fixture(autouse=True)
def double_precision():
    with jax.enable_x64(True):
        yield


@pytest.fixture(scope="session")
def derivative():
    return jax.jit(Quadrotor.derivative)


@pytest.fixture(scope="session")
def step():
    return jax.jit(Quadrotor.step)


@pytest.fixture
def states():
    """Eight states of fast, tilted flight above 0.3 m, and rotor speeds for them."""
    rng = np.random.default_rng(7)
    x = rng.normal(size=(8, 13))
    x[:, 2] = rng.uniform(0.3, 1.0, 8)
    x[:, 3:7] /= np.linalg.norm(x[:, 3:7], axis=1, keepdims=True)
    x[:, 7:10] *= 4
    x[:, 10:] *= 3
    return x, rng.uniform(200, 1000, (8, 4))


SPLITS = {"train": SplitSpec(200, 10), "test": SplitSpec(30, 100)}


@pytest.fixture(scope="session")
def source():
    return make_dataset(SOURCE, SPLITS, seed=3)
