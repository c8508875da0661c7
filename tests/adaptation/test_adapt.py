"""Laws of `adapt`: one call and one result for every system and method; and of its memory."""

import inspect
import json
import textwrap
import time
import warnings
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array, Float
from pendulum import LENGTH, Pendulum, flown, hybrid, pendulum, swings
from smoke import script
from surface import refusal

import hybrid_jax as hj
from hybrid_jax import (
    METHODS,
    AbstractVectorField,
    Adaptation,
    FineTune,
    LeastSquares,
    Method,
    Solution,
    adapt,
    runtime,
)
from hybrid_jax.dynamics.disturbance import ConstantDisturbance, disturbance_of, physics_of
from hybrid_jax.metrics import rollout_mse
from hybrid_jax.status import Status


class Own(hj.training.TrajectoryLoss.__base__):
    prepare = batch = loss = observe = validate = lambda self, *_: None


class Stretched(AbstractVectorField):
    """Another field with the unit of each state divided by a factor."""

    field: AbstractVectorField
    factor: tuple[float, ...] = eqx.field(static=True)

    def __call__(self, x, u):
        factor = jnp.asarray(self.factor)
        return self.field(x / factor, u) * factor


def test_units_of_the_states_do_not_matter():
    data = swings(40)  # damped: no length fits exactly, so weights decide
    noise = 0.05 * np.std(data.x, axis=(0, 1)) * np.random.default_rng(0).normal(size=data.x.shape)
    data = replace(data, x=np.asarray(data.x + noise, np.float32))
    factor = (1000.0, 0.01)
    stretched = replace(data, x0=np.asarray(data.x0) * factor, x=np.asarray(data.x) * factor)
    stretched = jax.tree.map(lambda leaf: np.asarray(leaf, np.float32), stretched)
    plain = adapt(pendulum(0.7), data, method="theta_least_squares").parameters["log_length"]
    options = {"method": "theta_least_squares", "settings": hj.Settings(solver=hj.RK4())}
    other = adapt(Stretched(pendulum(0.7), factor), stretched, **options)
    found = other.parameters["field.log_length"]
    np.testing.assert_allclose([found.value, found.low, found.high], [plain.value, plain.low, plain.high], rtol=1e-3)


@pytest.mark.parametrize("name", sorted(METHODS))
def test_every_method_has_the_same_result(name):
    data = flown(hybrid(LENGTH))
    method = METHODS[name]
    method = replace(method, max_epochs=3) if isinstance(method, FineTune) else name
    result = adapt(hybrid(0.55), data, method=method)
    assert np.isfinite(result.mse_after)
    assert jax.tree.structure(physics_of(result.field)) == jax.tree.structure(pendulum())
    fitted = "least_squares" in name or result.chosen in ("theta", "disturbance")  # and the network stayed as it is
    assert result.parameters["log_length"].has_interval == fitted
    assert result.method in result.report()
    assert ("No intervals" in result.report()) != fitted
    assert json.loads(json.dumps(result.to_dict()))["parameters"]["log_length"]["unit"] is None


def test_every_entry_of_a_result_is_json_and_none_where_it_is_not_finite():
    result = adapt(pendulum(), swings(40), method="theta_least_squares")
    unseen = replace(result.parameters["log_length"], high=np.inf)
    spoiled = replace(result, parameters={"log_length": unseen}, covariance=np.full((1, 1), np.inf), mse_after=np.nan)
    found = json.loads(json.dumps(spoiled.to_dict(), allow_nan=False))
    assert found["parameters"]["log_length"]["high"] is found["mse_after"] is None
    assert found["covariance"] == [[None]]


HOPELESS = {
    "fit": lambda field, windows: hj.fit(field, windows, windows, jax.random.key(0)),
    "fit_gauss_newton": hj.fit_gauss_newton,
    **{method: partial(adapt, method=method) for method in ("auto", "least_squares", "fine_tune")},
}


@pytest.mark.parametrize("fit", HOPELESS.values(), ids=HOPELESS)
def test_windows_whose_squares_overflow_diverge_before_a_step(fit):
    windows = swings(20)
    windows = replace(windows, x=np.full_like(windows.x, 1e30))  # finite itself
    result = fit(pendulum(), windows)
    assert result.status == Status.DIVERGED
    assert (result.epochs if hasattr(result, "epochs") else result.steps) == 0
    if isinstance(result, Adaptation):
        assert "diverged" in result.report()
        json.dumps(result.to_dict(), allow_nan=False)


@pytest.mark.parametrize("method", ["auto", "least_squares", "theta_least_squares"])
def test_a_fit_of_what_has_no_effect_has_not_converged(method):
    result = adapt(pendulum(), replace(swings(20), dt=1e-30), method=method)
    assert result.status == Status.STALLED
    assert "found no step that lowers the error" in result.report()


@pytest.mark.parametrize(("frozen", "moves"), [("residual", "physics"), ("physics", "residual")])
def test_what_is_frozen_stays(frozen, moves):
    field = hybrid(0.55)
    result = adapt(field, flown(hybrid(LENGTH)), method=FineTune(frozen=frozen, max_epochs=3))
    assert eqx.tree_equal(getattr(result.field, frozen), getattr(field, frozen))
    assert not eqx.tree_equal(getattr(result.field, moves), getattr(field, moves))


def test_a_method_of_a_user_is_the_example_of_the_docstring():
    lines = inspect.cleandoc(Method.__doc__ or "").splitlines()
    known = {"dataclass": dataclass, "AbstractVectorField": AbstractVectorField, "Solution": Solution}
    known["rollout_mse"] = rollout_mse
    exec(textwrap.dedent("\n".join(line for line in lines if not line or line[0] == " ")), known)
    method = known["BestOf"]((pendulum(0.3), pendulum(LENGTH), pendulum(0.9)))
    result = adapt(pendulum(0.7), swings(40, damping=0.0), method=method)
    assert result.method == "BestOf"
    assert eqx.tree_equal(result.field, pendulum(LENGTH))


class Recorded(hj.adaptation.Auto):
    def solve(self, field, train, validation, settings, learned_from=None):
        return Solution(field, status=jnp.array(Status.OK), steps=settings.objective.scale[1])


def test_errors_count_by_the_source_s_motion_also_in_a_hover():
    """Otherwise the source that is kept would depend on the flight that it adapts to."""
    hover = replace(swings(20), x0=1e-3 * swings(20).x0, x=1e-3 * swings(20).x)
    both = hover, swings(20)
    found = [adapt(hybrid(), each, method=Recorded(), learned_from=both[1]).steps for each in both]
    assert found[0] == found[1] > 0


class Nothing(AbstractVectorField):
    def __call__(self, x, u):
        return x


def test_a_disturbance_that_is_not_zero_is_moved_to_no_other_states():
    still = hj.with_disturbance(hj.with_disturbance(pendulum(), (0,)), (1,))
    assert disturbance_of(still).indices == (1,)
    with pytest.raises(ValueError, match="indices: the field already has a disturbance of other states"):
        hj.with_disturbance(hj.Hybrid(pendulum(), ConstantDisturbance(jnp.array([1.5]), (1,))), (0,))


class Weights(AbstractVectorField):
    gains: Float[Array, " n"]

    def __call__(self, x, u):
        return x * self.gains.sum()


def test_a_method_that_makes_no_sense_is_refused():
    refusal(lambda: FineTune(frozen="residuals"), "^frozen must be 'physics', 'residual' or None, got 'residuals'$")
    refusal(lambda: LeastSquares(indices=1), "^indices must be different integers of at least 0, got 1$")


WIDE = replace(swings(40), u=np.zeros((40, 8, 2), np.float32))


@pytest.mark.parametrize(
    ("field", "options", "said"),
    [
        (pendulum(), {"method": "magic"}, "method must be one of auto, .*source, or a Method, got 'magic'"),
        (pendulum(), {"method": 3}, "method must be a Method with a function solve, got 3"),
        (pendulum(), {"settings": hj.Settings(4, objective=Own())}, "^settings.objective must be .* got Own; .*fine_t"),
        (pendulum(), {"method": LeastSquares(indices=(9,))}, "indices must be different .* and at most 1, got"),
        (pendulum(), {"level": 95}, "level must be between 0 and 1, got 95"),
        (pendulum(), {"method": "theta_only"}, "field must be a Hybrid to freeze its residual, got Pendulum"),
        (pendulum(), {"learned_from": WIDE}, "^learned_from: inputs of 1 numbers expected, as in the other .* got 2"),
        (Nothing(), {}, "field: its physics, Nothing, has no parameter to fit"),
        (Weights(jnp.zeros(60)), {}, "field: Weights has 60 unnamed parameters, too many to fit; use"),
        (Weights(jnp.zeros(45)), {"method": "least_squares"}, "40 are too few for the 45 parameters of Weights"),
    ],
)
def test_bad_input_is_refused_in_one_line(field, options, said):
    with pytest.raises(ValueError, match=said) as caught:
        adapt(field, swings(40), **options)
    assert "\n" not in str(caught.value)


PATHS = "import sys; sys.path[:0] = ['tests', 'tests/adaptation']"


def adapted(method, sizes):
    """Memory [MiB] and processor time [s] after each adaptation."""
    warnings.simplefilter("ignore")
    jax.config.update("jax_enable_compilation_cache", False)  # the compiler takes 150 MiB where it is first needed
    network = hj.residual_network(2, 1, jax.random.key(0), hidden=4, norm="none", activation="tanh")
    field, flights = hj.Hybrid(Pendulum(jnp.float32(0.0)), network), swings(max(sizes))
    flights = jax.tree.map(np.asarray, flights)
    for size in sizes:
        began = time.process_time()
        hj.adapt(field, flights[:size], method=method)
        pages = int(Path("/proc/self/statm").read_text().split()[1])
        print(pages / 256, time.process_time() - began)


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="memory is read from Linux's /proc")
@pytest.mark.parametrize(("method", "sizes"), [("auto", "[40] * 500"), ("least_squares", "range(40, 90)")])
def test_memory_and_time_stay_where_they_are(method, sizes):
    """Every size of data has programs of its own, which took 46 MiB for ever."""
    code = f"{PATHS}; from test_adapt import adapted; adapted({method!r}, {sizes})"
    memory, seconds = np.array([list(map(float, line.split())) for line in script("-c", code).splitlines()]).T
    assert memory[-1] - memory[1] < 100
    if sizes.startswith("["):
        assert memory[99] < 1.05 * memory[1]
        assert np.median(seconds[90:110]) < 1.5 * np.median(seconds[1:11])


def test_programs_of_a_third_size_replace_the_others():
    made = []
    program = runtime.jit_by_size()(lambda x: made.append(x.shape) or x)
    for size in (1, 2, 1, 2, 3, 3, 1):
        runtime.keep_programs("test", size)
        program(jnp.zeros(size))
    assert made == [(1,), (2,), (3,), (1,)]
