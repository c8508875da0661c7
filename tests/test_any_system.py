"""Any system, also of a user's own, goes from fit to file: fit, adapt, save, load elsewhere, predict, export."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import casadi
import equinox as eqx
import jax
import numpy as np
import pytest
from smoke import script
from systems import SYSTEMS

import hybrid_jax as hj
from hybrid_jax.export import casadi_function, export_program, load_program
from hybrid_jax.metrics import rollout_mse

pytestmark = pytest.mark.slow
# Few epochs: what is checked is that every method goes through, not how well it does.
FEW = {"min_epochs": 1, "max_epochs": 5}
METHODS = {name: replace(one, **FEW) if isinstance(one, hj.FineTune) else one for name, one in hj.METHODS.items()}
LOADED_ELSEWHERE = """
import sys
sys.path.insert(0, sys.argv[1])
import numpy as np, hybrid_jax as hj, systems
for file in sys.argv[3:]:
    test = systems.SYSTEMS[sys.argv[2]]().test
    np.save(file + ".predicted.npy", hj.load(file).predict(test.x0, test.u, test.dt))
"""


def attempt(call, *arguments, **options):
    """The result, or the text of the ValueError."""
    try:
        return call(*arguments, **options)
    except ValueError as error:
        return str(error)


@pytest.fixture(scope="module", params=["car", "multirotor", "circle", "ring_convolution", "wrapper"])
def adapted(request):
    """A system, its source model and what each method made of it."""
    system = SYSTEMS[request.param]()
    source = hj.fit(system.model, system.train, system.validation, jax.random.key(0), max_epochs=60)
    given, validation = (source.best, system.target), system.validation
    results = {name: attempt(hj.adapt, *given, method=one, validation=validation) for name, one in METHODS.items()}
    return SimpleNamespace(name=request.param, system=system, source=source, results=results)


def fields(adapted):
    """Name of the method → adapted field, where the method applies."""
    return {name: found.field for name, found in adapted.results.items() if not isinstance(found, str)}


def test_a_fit_beats_physics_every_method_adapts_or_refuses_in_a_line_and_least_squares_improves(adapted):
    system = adapted.system
    assert adapted.source.best_mse < eqx.filter_jit(rollout_mse)(system.model.physics, system.validation)
    fitted = adapted.results["least_squares"].field
    before, after = (rollout_mse(field, adapted.system.test) for field in (adapted.source.best, fitted))
    assert after < before
    refused = {name: found for name, found in adapted.results.items() if isinstance(found, str)}
    # The output layer of a user's own network is not known.
    assert set(refused) <= {"last_layer"}
    assert all("\n" not in text and "ResidualNetwork" in text for text in refused.values())
    for name, result in adapted.results.items():
        if name not in refused:
            assert isinstance(result, hj.Adaptation)
            assert np.isfinite(result.mse_after)
            assert result.report().startswith(f"Adapted to {len(adapted.system.target)} windows")
            assert result.to_dict()["status"] == str(result.status)


def test_a_file_gives_the_same_model_in_another_process(adapted, tmp_path):
    test, kept = adapted.system.test, fields(adapted)
    for name, field in kept.items():
        hj.save(tmp_path / f"{name}.npz", field)
    files = [str(tmp_path / f"{name}.npz") for name in kept]
    script("-c", LOADED_ELSEWHERE, Path(__file__).parent, adapted.name, *files)
    for name, field in kept.items():
        predicted = hj.Model(field).predict(test.x0, test.u, test.dt)
        np.testing.assert_array_equal(np.load(tmp_path / f"{name}.npz.predicted.npy"), predicted, err_msg=name)


@pytest.mark.parametrize("method", ["least_squares", "linear_residual"])
def test_an_exported_step_is_the_model_s(adapted, method, tmp_path):
    test, field = adapted.system.test, fields(adapted)[method]
    sizes = {"state_size": test.x0.shape[1], "input_size": test.u.shape[2]}
    x, u = np.asarray(test.x0[0]), np.asarray(test.u[0, 0])
    expected = hj.rollout(field, x, u[None], test.dt)[0]
    scale = float(np.abs(expected).max())
    export_program(tmp_path / "step.npz", field, test.dt, **sizes)
    np.testing.assert_allclose(load_program(tmp_path / "step.npz")(x, u), expected, atol=1e-6 * scale)
    step = attempt(casadi_function, field, test.dt, **sizes)
    if isinstance(step, casadi.Function):
        np.testing.assert_allclose(np.ravel(step(x, u)), expected, atol=1e-5 * scale)
    else:
        assert "\n" not in step
        assert "conv_general_dilated" in step
