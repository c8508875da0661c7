"""Laws of fitting θ_p by least squares."""

import warnings

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from pendulum import LENGTH, Push, pendulum, pushes, swings
from surface import refusal

import hybrid_jax as hj
from hybrid_jax.dynamics.by_product import fixed_residual
from hybrid_jax.estimation import least_squares, levenberg_marquardt
from hybrid_jax.metrics import rollout_mse
from hybrid_jax.networks import zero_output
from hybrid_jax.status import Status

_mse, _flown = eqx.filter_jit(rollout_mse), eqx.filter_jit(hj.rollout_batch)
EXACT, DAMPED = swings(40, damping=0.0), swings(40)  # of a pendulum as the model has it, and of one with damping


def test_in_double_precision_the_fit_is_exact_to_more_digits():
    with jax.enable_x64(True):
        x0, u = (jnp.asarray(a, float) for a in (EXACT.x0, EXACT.u))
        windows = hj.Trajectories(x0, u, _flown(pendulum(), x0, u, EXACT.dt), EXACT.dt)
        found = hj.fit_least_squares(pendulum(LENGTH * 1.25), windows)
        assert found.converged
        np.testing.assert_allclose(jnp.exp(found.field.log_length), LENGTH, rtol=1e-12)  # of 640 states at 1e-16
        # A single-precision field stays one where JAX computes in double precision.
        single = eqx.tree_at(lambda field: field.log_length, pendulum(), jnp.log(jnp.float32(LENGTH * 1.25)))
        found = hj.fit_least_squares(single, EXACT)
        assert found.converged
        assert found.field.log_length.dtype == jnp.float32


@pytest.mark.parametrize("unit", [1e-4, 1.0, 1e4])
def test_a_linear_problem_meets_its_closed_form_in_any_unit(unit):
    windows, design = pushes(30, 0.1, unit)
    gains = np.linalg.lstsq(design.reshape(-1, 2), np.asarray(windows.x, float).ravel())[0]
    found = hj.fit_least_squares(Push(unit * jnp.array([1.0, 1.0])), windows)
    assert found.converged
    # Half a step of float32 in each of some hundred terms.
    np.testing.assert_allclose(found.field.gains, gains, rtol=1e-5)
    # One step would do without damping; with 1e-3 of it each step leaves 1e-3 of the error.
    assert found.steps <= 6


def test_a_residual_is_differentiated_by_the_product_that_jax_would_form():
    field, key = pendulum(), jax.random.key(0)
    field = hj.Hybrid(field, hj.residual_network(2, EXACT.u.shape[-1], key, hidden=5, norm="none", activation="tanh"))
    x, u = EXACT.x0[0], EXACT.u[0, 0]
    own, plain = (jax.jacfwd(each)(x, u) for each in (fixed_residual(field), field))
    np.testing.assert_allclose(own, plain, rtol=1e-5, atol=1e-6)
    # Weights move too where somebody differentiates by them.
    found = eqx.filter_jvp(lambda field: fixed_residual(field)(x, u), (field,), (field,))[1]
    plain = eqx.filter_jvp(lambda field: field(x, u), (field,), (field,))[1]
    np.testing.assert_allclose(found, plain, rtol=1e-5, atol=1e-6)


def test_many_windows_are_fitted_a_few_at_a_time_with_the_same_result(monkeypatch):
    (windows, _), start = pushes(30, 0.1, 1.0), Push(jnp.array([1.0, 1.0]))
    whole = hj.fit_least_squares(start, windows)
    monkeypatch.setattr(least_squares, "MANY", 20)
    monkeypatch.setattr(least_squares, "CHUNK", 8)  # not a part of 30
    parts = hj.fit_least_squares(start, windows, max_steps=99)  # traced anew
    assert (parts.converged, parts.steps) == (whole.converged, whole.steps)
    np.testing.assert_allclose(parts.field.gains, whole.field.gains, rtol=1e-5)
    np.testing.assert_allclose(parts.mse, whole.mse, rtol=1e-5)
    assert parts.discretisation < 0.1


class Coil(hj.AbstractVectorField):
    """The current in a coil of resistance 1 Ω, a motor's without its rotor."""

    log_inductance: jax.Array

    def __call__(self, x, u):
        return (u - x) / jnp.exp(self.log_inductance)


@pytest.mark.parametrize(("substeps", "biased"), [(1, True), (4, False)])
def test_a_step_that_biases_a_parameter_is_said(substeps, biased):
    """Steps of 10 ms of a coil with 15 ms, or of 8 ms for a network, which would learn the error."""
    random, truth = np.random.default_rng(0), Coil(jnp.log(0.015))
    x0, u = random.normal(size=(400, 1)), np.repeat(random.normal(size=(400, 5, 1)), 2, axis=1)
    x = np.asarray(hj.rollout_batch(truth, x0, u, 0.01, hj.RK4(substeps=8)))
    windows = hj.Trajectories(x0, u, x + 2e-3 * random.normal(size=x.shape), 0.01)
    settings, key = hj.Settings(solver=(solver := hj.RK4(substeps=substeps))), jax.random.key(0)
    with warnings.catch_warnings(record=True, action="always") as said:
        found = hj.fit_least_squares(Coil(jnp.log(0.03)), windows, solver=solver)
    error = np.asarray(jnp.sqrt(hj.covariance_of(found.field, windows, solver=solver)))[0, 0]
    off = abs(float(found.field.log_inductance) - np.log(0.015)) / error
    assert (off > 4) == biased == bool(said)
    assert float(found.discretisation) == pytest.approx(off, rel=0.5) if biased else found.discretisation < 0.1
    fast, once = Coil(jnp.log(0.008)), {"key": key, "rates": 0.0, "max_epochs": 1, "settings": settings}
    exact = hj.Trajectories(x0, u, np.asarray(hj.rollout_batch(fast, x0, u, 0.01, hj.RK4(substeps=16))), 0.01)
    network = hj.Hybrid(fast, zero_output(hj.residual_network(1, 1, key, hidden=4)))
    for fit in (
        lambda: hj.adapt(found.field, windows, method=hj.LeastSquares(disturbance=False), settings=settings),
        lambda: hj.fit(found.field, windows, windows, **once),
        lambda: hj.fit(network, exact, exact, **once),
        lambda: hj.fit_gauss_newton(found.field, windows, solver=solver),
    ):
        with warnings.catch_warnings(record=True, action="always") as said:
            fit()
        assert [w.filename for w in said if "half the solver's step" in str(w.message)] == [__file__] * biased


def test_an_implicit_solver_that_finds_no_step_ends_in_a_line():
    given = Coil(jnp.array(-1e3)), hj.Trajectories(np.zeros((2, 1)), np.ones((2, 3, 1)), np.zeros((2, 3, 1)), 0.01)
    solver, words = diffrax.ImplicitEuler(), "solver: ImplicitEuler cannot solve a step of a trial model"
    refusal(lambda: hj.fit_least_squares(*given, solver=solver), words)
    refusal(lambda: hj.adapt(*given, settings=hj.Settings(solver=solver)), words)


def test_it_is_the_minimum_of_l_mse_to_which_a_run_that_is_cut_short_comes_nearer():
    found = hj.fit_least_squares(pendulum(0.8), DAMPED)
    assert found.converged
    assert found.steps <= 8  # more would be lost in rounding, which hides what they gain
    np.testing.assert_allclose(found.mse, _mse(found.field, DAMPED), rtol=1e-6)  # another order of sums
    for shift in (-1e-2, 1e-2):
        moved = eqx.tree_at(lambda field: field.log_length, found.field, found.field.log_length + shift)
        assert _mse(moved, DAMPED) > found.mse
    short = hj.fit_least_squares(pendulum(0.8), DAMPED, max_steps=2)
    assert (short.converged, short.steps) == (False, 2)
    assert found.mse < short.mse < _mse(pendulum(0.8), DAMPED)


def test_a_lane_is_the_run_alone_a_lost_lane_harms_no_other_and_infinite_states_are_refused():
    stacked = eqx.filter_vmap(pendulum)(jnp.array(lengths := (0.4, 0.6, np.nan, 0.9)))
    together = eqx.filter_jit(eqx.filter_vmap(lambda field: hj.fit_least_squares(field, DAMPED)))(stacked)
    np.testing.assert_array_equal(together.converged, [True, True, False, True])
    for i in (0, 1, 3):
        alone = hj.fit_least_squares(pendulum(lengths[i]), DAMPED)
        # Another program for the same sums; one step more may be taken or not, where rounding hides its gain.
        np.testing.assert_allclose(together.field.log_length[i], alone.field.log_length, rtol=1e-5)
        np.testing.assert_allclose(together.mse[i], alone.mse, rtol=1e-5)
    spoiled = eqx.tree_at(lambda w: w.x, EXACT, EXACT.x.at[3, 1, 0].set(jnp.inf))
    refusal(lambda: hj.fit_least_squares(pendulum(0.8), spoiled), "windows: x[3, 1, 0] is not finite")
    found = eqx.filter_jit(hj.fit_least_squares)(pendulum(0.8), spoiled)
    assert (found.converged, found.field.log_length) == (False, pendulum(0.8).log_length)


def test_a_narrow_curved_valley_takes_few_steps():
    def evaluate(z, _):
        def errors(z):
            return jnp.stack([1e3 * (z[1] - z[0] ** 2), 1 - z[0]])

        return jnp.sum(errors(z) ** 2), (z, errors(z), jax.jacfwd(errors)(z))

    def aim(best, damping):
        z, r, jacobian = best
        move, expected = levenberg_marquardt.move_of_equations(jacobian.T @ jacobian, jacobian.T @ r, damping)
        return z + move, expected, 0.0

    with jax.enable_x64(True):
        begun = (start := jnp.array([-1.2, 1.0])), (start, jnp.zeros(2), jnp.zeros((2, 2)))
        end = levenberg_marquardt.minimise(evaluate, aim, levenberg_marquardt.begin(*begun), 1000)
    np.testing.assert_allclose(end.best[0], 1.0, atol=1e-6)
    assert end.steps < 400  # 509 if the damping falls only after steps that are as good as expected


@pytest.mark.parametrize(("slope", "status"), [(1.0, Status.STALLED), (1e-4, Status.OK)])
def test_a_fit_that_no_step_lowers_has_not_converged_if_more_was_expected(slope, status):
    """The cost rises where the derivative says that it falls, by much or by what may be rounding."""

    def evaluate(z, _):
        return 1 + slope * jnp.abs(z[0]), z

    def aim(z, damping):
        return (*levenberg_marquardt.move_of_equations(jnp.eye(1), jnp.full(1, slope), damping), 0.0)

    begun = levenberg_marquardt.begin(jnp.zeros(1), jnp.zeros(1))
    assert levenberg_marquardt.minimise(evaluate, aim, begun, 1000).status == status
