"""Laws of the covariance of θ_p, against closed forms, and of its intervals, against simulation."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array, Float
from pendulum import Brake, log_lengths, pendulum, swings
from pushes import Push, pushes
from rich.console import Console

from experiments.paper.known_body import coverage
from hybrid_jax.dynamics.base import AbstractVectorField
from hybrid_jax.dynamics.composition import Hybrid
from hybrid_jax.dynamics.rigid_body import rigid_body
from hybrid_jax.estimation.least_squares import fit_least_squares
from hybrid_jax.estimation.uncertainty import covariance_of, intervals
from hybrid_jax.status import Status
from hybrid_jax.vehicle import IRIS

SWINGS = swings(40)
COVARIANCE = jnp.diag(jnp.array([0.01, 0.02, 0.03]) ** 2)  # of log Ix, log Iy, log k


def closed_form(windows, design, gains, kind):
    """The covariance of a linear problem, in double precision, as the docstring writes it."""
    n, _, p = design.shape
    errors = np.asarray(windows.x, float).reshape(n, -1) - design @ np.asarray(gains, float)
    bread = np.linalg.inv(np.einsum("nip,niq->pq", design, design))
    if kind == "homoscedastic":
        return (errors**2).sum() / (errors.size - p) * bread
    scores = np.einsum("nip,ni->np", design, errors)
    return n / (n - p) * bread @ (scores.T @ scores) @ bread


@pytest.mark.parametrize("kind", ["sandwich", "homoscedastic"])
def test_a_linear_problem_meets_its_closed_form(kind):
    windows, design = pushes(30, 0.1)
    offset = 0.2 * np.random.default_rng(1).normal(size=(30, 1, 2))  # an error that a whole window shares
    windows = eqx.tree_at(lambda w: w.x, windows, windows.x + np.asarray(offset, np.float32))
    field = fit_least_squares(Push(jnp.ones(2)), windows).field
    expected = closed_form(windows, design, field.gains, kind)
    np.testing.assert_allclose(covariance_of(field, windows, kind=kind), expected, rtol=1e-4)  # float32 sums
    # In pieces that do not divide the windows the sums are the same.
    np.testing.assert_allclose(covariance_of(field, windows, kind=kind, chunk=7), expected, rtol=1e-4)


def test_a_lane_is_the_covariance_alone():
    lengths = (0.45, 0.55, 0.6)
    together = eqx.filter_jit(eqx.filter_vmap(lambda field: covariance_of(field, SWINGS)))(log_lengths(*lengths))
    alone = [covariance_of(pendulum(length), SWINGS) for length in lengths]
    np.testing.assert_allclose(together, alone, rtol=1e-5)  # another order of float32 sums


def test_a_residual_is_taken_as_given():
    bare, hybrid = (covariance_of(field, SWINGS) for field in (pendulum(), Hybrid(pendulum(), Brake(jnp.array(0.0)))))
    np.testing.assert_allclose(hybrid, bare, rtol=1e-5)  # float32


def test_a_parameter_that_the_windows_do_not_depend_on_stays_and_may_be_anything():
    windows, _ = pushes(30, 0.1)
    still = eqx.tree_at(lambda w: w.u, windows, windows.u * np.float32([1, 0]))
    first = np.float32([1, np.inf])  # the second state, which the second gain moves as well, does not count
    found = fit_least_squares(Push(jnp.array([1.0, 7.0])), still, scale=first)
    covariance = covariance_of(found.field, still, scale=first)
    assert tuple(intervals(found.field, covariance)["gains[1]"]) == (7, -np.inf, np.inf)
    # The other one is found as it is where the second is known.
    known = covariance_of(found.field, still, scale=first, free=np.array([True, False]))
    assert found.converged
    assert 0 < known[0, 0] < np.inf
    dark = eqx.tree_at(lambda w: w.u, windows, 0 * windows.u)
    assert fit_least_squares(Push(jnp.ones(2)), dark).status == Status.STALLED  # it has seen nothing
    np.testing.assert_allclose(covariance[0, 0], known[0, 0] * 29 / 28, rtol=1e-5)  # the factor n / (n - p)


class Sum(AbstractVectorField):
    """ẋ = (a + b) u₀ + c u₁: no window tells a and b apart."""

    a: Float[Array, ""]
    b: Float[Array, ""]
    c: Float[Array, ""]

    def __call__(self, x, u):
        return jnp.stack([(self.a + self.b) * u[0] + self.c * u[1], 0 * x[1]])


@pytest.mark.parametrize("unit", [0.01, 0.3, 1.0, 7.0, 100.0])
@pytest.mark.parametrize("cluster", [1, 6])
def test_parameters_that_no_window_tells_apart_have_no_interval_and_others_have_theirs(unit, cluster):
    windows, _ = pushes(30, 0.1, unit)
    found = fit_least_squares(Sum(*map(jnp.array, (1.0, 0.5, 0.0))), windows)
    variances = np.diagonal(covariance_of(found.field, windows, cluster=cluster))
    assert np.isinf(variances[:2]).all()
    alone = Sum(found.field.a + found.field.b, jnp.zeros(()), found.field.c)
    known = covariance_of(alone, windows, cluster=cluster, free=np.array([True, False, True]))
    factor = 1.0 if cluster > 1 else 28 / 27  # n - p
    np.testing.assert_allclose(variances[2], known[2, 2] * factor, rtol=1e-3)


def test_one_long_record_has_an_interval_if_its_noise_is_white():
    assert 0 < float(covariance_of(pendulum(), SWINGS[:1], kind="homoscedastic")[0, 0]) < np.inf


def test_what_makes_no_sense_is_refused():
    with pytest.raises(ValueError, match=r"windows: 1 are too few for the 1 parameters of Pendulum, at least 2"):
        covariance_of(pendulum(), SWINGS[:1])
    with pytest.raises(ValueError, match="kind must be one of sandwich, homoscedastic, got 'plain'"):
        covariance_of(pendulum(), SWINGS, kind="plain")
    with pytest.raises(ValueError, match="kind must be sandwich where an error is given"):
        covariance_of(pendulum(), SWINGS, kind="homoscedastic", error=jnp.sum)
    for level in (0.0, 1.0, 95, float("nan")):
        with pytest.raises(ValueError, match=f"level must be between 0 and 1, got {level}"):
            intervals(rigid_body(IRIS), COVARIANCE, level)


REPEATS = 100


@pytest.fixture(scope="module")
def found():
    return coverage(REPEATS, Console(quiet=True))


@pytest.fixture(scope="module")
def rows(found):
    return {(row["case"], row["noise_on"], row["parameter"]): row for row in found}


@pytest.mark.slow
@pytest.mark.parametrize("noise_on", ["targets", "all"])
@pytest.mark.parametrize("name", ["Ix", "Iy", "k"])
def test_intervals_cover_the_truth_of_exact_physics(noise_on, name, rows):
    row = rows["exact physics", noise_on, name]
    assert row["converged"] == 1
    # 100 draws of 95 %: a standard deviation of 2.2 %, four of these down; all draws up are two and a half.
    assert row["coverage"] > 0.95 - 4 * np.sqrt(0.95 * 0.05 / REPEATS)
    # A half-width is 1.96 standard errors; the mean of 100 fits is within four of its own: there is no bias.
    assert abs(row["bias"]) < 4 * row["half_width"] / 1.96 / np.sqrt(REPEATS)


@pytest.mark.slow
def test_intervals_miss_the_truth_when_the_vehicle_has_drag_that_the_model_has_not(rows):
    """Drag pulls against the lean into the velocity, as a smaller k would."""
    row = rows["unknown drag", "targets", "k"]
    assert row["coverage"] < 0.5
    # c v / m of drag against a lean of c v / (m g): c² E[v_x² + v_y²] / (m g)², with 2 m/s along each axis. The mean
    # of 100 fits is good to 0.03 %; drag on what is vertical or beside the lean averages out.
    np.testing.assert_allclose(row["bias"], -100 * 0.4**2 * 8 / (1.5 * 9.81) ** 2, atol=0.15)
