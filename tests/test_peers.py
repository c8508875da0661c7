"""Rivals are timed where they are installed and named where they are not; how fast they are, nobody asks here."""

import sys
from importlib.util import find_spec

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from pendulum import pendulum
from smoke import benchmark

from benchmarks.subjects import make_flights, subject
from benchmarks.training_peers import BY_HAND, COMPILED, TORCHDIFFEQ, ThreeEighths
from hybrid_jax.integrate import RK4, rollout

pytestmark = pytest.mark.slow


def test_the_gradient_step_of_every_rival_is_ours_on_one_core(tmp_path):
    _, report = benchmark("training_peers", tmp_path)
    assert report["cores_used"] == 1 or sys.platform != "linux"
    rows = {row["program"]: row for row in report["rows"] if "program" in row}
    assert rows["ours without kernels"]["difference"] < 1e-5
    pytest.importorskip("torch", reason="PyTorch is of the extra `peers`")
    for rival in (BY_HAND, COMPILED) + ((TORCHDIFFEQ,) if find_spec("torchdiffeq") else ()):
        assert rows[rival]["difference"] < 5e-5  # sums in another order, in float32


@pytest.mark.parametrize("name", ["paper", "vehicle"])
def test_the_field_of_the_rivals_is_ours(name):
    pytest.importorskip("torch", reason="PyTorch is of the extra `peers`")
    from benchmarks.torch_rivals import Hybrid, tensor

    field = subject(name, 2, 1)[0]
    x, u = (part.astype(np.float32) for part in make_flights(30, 1))
    ours = field.train_batch(jnp.asarray(x.T), jnp.asarray(u[:, 0].T)).T
    theirs = Hybrid(field)(tensor(x), tensor(u[:, 0])).detach().numpy()
    np.testing.assert_allclose(theirs, ours, rtol=0, atol=1e-6 * np.abs(ours).max())


def test_the_rule_of_torchdiffeq_is_of_fourth_order_and_another():
    with jax.enable_x64(True):
        x0 = jnp.array([0.5, -1.0])

        def end(solver, steps):
            return rollout(pendulum(), x0, jnp.zeros((steps, 1)), 0.8 / steps, solver)[-1]

        truth = end(RK4(), 512)
        errors = [np.abs(end(ThreeEighths(), steps) - truth).max() for steps in (8, 16)]
        assert 3.7 < np.log2(errors[0] / errors[1]) < 4.6
        assert np.abs(end(ThreeEighths(), 8) - end(RK4(), 8)).max() > 1e-6  # far above rounding
