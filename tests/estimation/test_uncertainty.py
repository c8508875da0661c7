"""Laws of the covariance of θ_p, against closed forms, of its intervals, against simulation, and of what both need."""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array, Float
from pendulum import Push, pendulum, pushes, swings

import hybrid_jax as hj
from experiments.paper.conditions import measure, sensor_noise
from hybrid_jax import IRIS, AbstractVectorField, Hybrid, fit_least_squares, rigid_body, with_disturbance
from hybrid_jax.batches import in_chunks, solve
from hybrid_jax.estimation.normal_equations import equations_of, inverses
from hybrid_jax.estimation.uncertainty import sandwich, sandwich_with_prior
from hybrid_jax.rotation import normalise
from hybrid_jax.status import Status
from hybrid_jax.vehicle import QUATERNION

ROOTS = np.random.default_rng(0).normal(size=(4, 3, 3)).astype(np.float32)
POSITIVE, RIGHT = ROOTS @ ROOTS.swapaxes(1, 2) + np.eye(3, dtype=np.float32), np.ones((4, 3, 2), np.float32)


def closed_form(windows, design, gains):
    """The covariance of a linear problem, in double precision, as the docstring writes it."""
    n, _, p = design.shape
    errors = np.asarray(windows.x, float).reshape(n, -1) - design @ np.asarray(gains, float)
    bread = np.linalg.inv(np.einsum("nip,niq->pq", design, design))
    scores = np.einsum("nip,ni->np", design, errors)
    return n / (n - p) * bread @ (scores.T @ scores) @ bread


def test_a_linear_problem_meets_its_closed_form_also_with_parameters_told_apart_by_little():
    windows, design = pushes(30, 0.1)
    offset = 0.2 * np.random.default_rng(1).normal(size=(30, 1, 2))  # an error that a whole window shares
    windows = eqx.tree_at(lambda w: w.x, windows, windows.x + np.asarray(offset, np.float32))
    field = fit_least_squares(Push(jnp.ones(2)), windows).field
    expected = closed_form(windows, design, field.gains)
    np.testing.assert_allclose(hj.covariance_of(field, windows), expected, rtol=1e-4)  # float32 sums
    # In pieces that do not divide the windows the sums are the same.
    np.testing.assert_allclose(hj.covariance_of(field, windows, chunk=7), expected, rtol=1e-4)
    windows, design = pushes(30, 1e-3)
    field = fit_least_squares(Pair(jnp.ones(2)), windows).field
    expected = closed_form(windows, design @ np.array([[1.0, 1.0], [6e-4, -6e-4]]), field.parts)
    np.testing.assert_allclose(hj.covariance_of(field, windows), expected, rtol=0.3)  # float32 sums
    with pytest.raises(ValueError, match=r"windows: 1 are too few for the 1 parameters of Pendulum, at least 2"):
        hj.covariance_of(pendulum(), swings(1))


class Pair(AbstractVectorField):
    """`Push` by the sum of two parameters and by a small part of their difference."""

    parts: Float[Array, " 2"]

    def __call__(self, x, u):
        return Push(jnp.array([[1.0, 1.0], [6e-4, -6e-4]]) @ self.parts)(x, u)


def test_a_parameter_that_the_windows_do_not_depend_on_stays_and_may_be_anything():
    windows, _ = pushes(30, 0.1)
    still = eqx.tree_at(lambda w: w.u, windows, windows.u * np.float32([1, 0]))
    first = np.float32([1, np.inf])  # the second state, which the second gain moves as well, does not count
    found = fit_least_squares(Push(jnp.array([1.0, 7.0])), still, scale=first)
    covariance = hj.covariance_of(found.field, still, scale=first)
    assert tuple(hj.intervals(found.field, covariance)["gains[1]"]) == (7, -np.inf, np.inf)
    # The other one is found as it is where the second is known.
    known = hj.covariance_of(found.field, still, scale=first, free=np.array([True, False]))
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
    variances = np.diagonal(hj.covariance_of(found.field, windows, cluster=cluster))
    assert np.isinf(variances[:2]).all()
    alone = Sum(found.field.a + found.field.b, jnp.zeros(()), found.field.c)
    known = hj.covariance_of(alone, windows, cluster=cluster, free=np.array([True, False, True]))
    factor = 1.0 if cluster > 1 else 28 / 27  # n - p
    np.testing.assert_allclose(variances[2], known[2, 2] * factor, rtol=1e-3)


LEARN = ("Ix", "k_rotors", "drag")
ERRORS = np.arange(1, 9) / 100  # in the order of the leaves: Ix, drag, k_rotors
Z = 1.959964  # of 95 %, from the normal distribution's table


@pytest.mark.parametrize("alike", [0.3, 1e-2, 1e-4])
def test_a_prior_bounds_what_windows_do_not_tell_apart_and_repeated_windows_add_nothing(alike):
    """The variance along a direction with information λ and precision κ of the prior is λ / (λ + κ)² ≤ 1 / 4κ."""
    rng, size, windows, fitted = np.random.default_rng(0), 0.5, 400, 3
    design = rng.normal(size=(windows, 5, fitted))
    design[..., 2] = design[..., 1] + alike * design[..., 2]
    equations = jax.vmap(equations_of)(jnp.asarray(design), errors := 0.1 * rng.normal(size=(windows, 5)))
    of = partial(sandwich_with_prior, fitted=fitted, distinct=jnp.array(windows))
    held, step = of(equations, precision=jnp.full(fitted, 0.01 / size**2))
    rows = design.reshape(-1, fitted)
    ridge = -np.linalg.solve(rows.T @ rows + np.eye(fitted) * 0.01 / size**2, rows.T @ errors.ravel())
    np.testing.assert_allclose(step, ridge, rtol=0.01)
    assert held[1, 1] + held[2, 2] - 2 * held[1, 2] < 2 * 1.2 * size**2 / 4
    np.testing.assert_allclose(held[0, 0], sandwich(equations, fitted)[0, 0], rtol=0.01)
    twice = jax.tree.map(lambda leaf: jnp.concatenate([leaf, leaf]), equations)
    np.testing.assert_allclose(of(twice, precision=jnp.full(fitted, 0.02 / size**2))[0], held, rtol=1e-3, atol=1e-6)


@pytest.mark.parametrize(("level", "z"), [(0.6826895, 1.0), (0.95, Z)])
@pytest.mark.parametrize("wrap", [lambda field: field, lambda field: Hybrid(field, Push(jnp.ones(2)))])
def test_every_entry_has_its_interval_in_si_units(wrap, level, z):
    found = hj.intervals(wrap(rigid_body(IRIS, LEARN)), np.diag(ERRORS**2), level)
    drag, rotors = ([f"{name}[{i}]" for i in range(count)] for name, count in (("drag", 3), ("k_rotors", 4)))
    assert set(found) == {"Ix", *drag, *rotors}
    for name, error in zip(("Ix", *rotors), ERRORS[[0, 4, 5, 6, 7]], strict=True):
        value, low, high = found[name]  # held as a logarithm
        np.testing.assert_allclose([high / value, value / low], np.exp(z * error), rtol=1e-5)  # float32
    for name, error in zip(drag, ERRORS[1:4], strict=True):
        assert found[name].value == 0  # held in units of the vehicle's weight at 1 m/s
        np.testing.assert_allclose(found[name][1:], z * error * IRIS.mass * IRIS.gravity * np.array([-1, 1]), rtol=1e-5)


def test_matrices_and_a_disturbance_have_intervals_entry_by_entry():
    found = hj.intervals(rigid_body(IRIS, ("aerodynamic_moment",)), np.eye(9) * 1e-4)
    assert list(found) == [f"aerodynamic_moment[{i},{j}]" for i in range(3) for j in range(3)]
    field = Hybrid(with_disturbance(rigid_body(IRIS)), Push(jnp.ones(2)))
    found = hj.intervals(field, np.eye(9) * 1e-4)
    assert list(found) == ["Ix", "Iy", "k", *(f"disturbance[{name}]" for name in ("vx", "vy", "vz", "wx", "wy", "wz"))]
    np.testing.assert_allclose(found["disturbance[wz]"], Z * 0.01 * np.array([0, -1, 1]), rtol=1e-5)  # float32


REPEATS = 100
SPREAD = np.repeat([0.0, 0.05, 2.0, 1.0], [3, 4, 3, 3])  # m, of a quaternion, m/s, rad/s


@eqx.filter_jit
def fitted(measured, key):
    """θ_p of a rigid body from a hundred noisy windows of 0.1 s, and its intervals, over the truth."""
    truth = hj.RigidBody({"Ix": jnp.array(0.3), "Iy": jnp.array(-0.3), "k": jnp.zeros(())}, IRIS)
    keys = jax.random.split(key, 4)
    x0 = jnp.zeros((100, 13)).at[:, 3].set(1.0) + SPREAD * jax.random.normal(keys[0], (100, 13))
    x0 = x0.at[:, QUATERNION].set(normalise(x0[:, QUATERNION]))
    u = IRIS.hover_speed + 40 * jax.random.normal(keys[1], (100, 10, 4))
    x = measure(hj.rollout_batch(truth, x0, u, 0.01), sensor_noise(1.0), keys[2])
    windows = hj.Trajectories(jnp.where(measured, measure(x0, sensor_noise(1.0), keys[3]), x0), u, x, 0.01)
    found = fit_least_squares(rigid_body(IRIS), windows)
    around, true = hj.intervals(found.field, hj.covariance_of(found.field, windows), 0.95), truth.theta()
    return found.converged, jnp.stack([jnp.stack(around[name]) / true[name] for name in true])


@pytest.mark.slow
@pytest.mark.parametrize("measured", [False, True], ids=["start known", "start measured"])
def test_intervals_cover_the_truth_of_exact_physics(measured):
    each = [fitted(measured, key) for key in jax.random.split(jax.random.key(0), REPEATS)]
    assert all(converged for converged, _ in each)
    value, low, high = np.stack([found for _, found in each], axis=-1).transpose(1, 0, 2)
    # 100 draws of 95 %: a standard deviation of 2.2 %, four of these down; all draws up are two and a half.
    assert ((low <= 1) & (high >= 1)).mean(axis=1).min() > 0.95 - 4 * np.sqrt(0.95 * 0.05 / REPEATS)
    # A half-width is 1.96 standard errors; the mean of 100 fits is within four of its own: there is no bias.
    error = (high - low).mean(axis=1) / (2 * Z * np.sqrt(REPEATS))
    assert (np.abs(value.mean(axis=1) - 1) < 4 * error).all()


@pytest.mark.parametrize(
    ("function", "arguments", "expected"),
    [
        (jax.vmap(solve), (POSITIVE, RIGHT), np.linalg.solve(POSITIVE, RIGHT)),
        (lambda grams: inverses(grams).matrix, (POSITIVE,), np.linalg.inv(POSITIVE)),
    ],
)
def test_no_batch_is_factored_at_once(function, arguments, expected):
    np.testing.assert_allclose(function(*arguments), expected, atol=1e-4)
    calls = [line for line in jax.jit(function).lower(*arguments).as_text().splitlines() if "lapack" in line]
    assert calls
    assert not any("4x3x3" in line for line in calls), calls


def test_a_derivative_goes_through_an_inverse():
    slope = jax.grad(lambda scale: jnp.sum(inverses(scale * POSITIVE).matrix))(2.0)
    np.testing.assert_allclose(slope, -np.linalg.inv(POSITIVE).sum() / 4, rtol=1e-4)


def norms(values):
    return {"norm": jnp.linalg.norm(values, axis=1), "cube": values**3}


@pytest.mark.parametrize("size", [1, 4, 5, 7, 9])
def test_results_do_not_depend_on_the_size_of_chunks(size):
    values = np.random.default_rng(0).normal(size=(7, 2)).astype(np.float32)
    found = in_chunks(norms, values, size)
    jax.tree.map(partial(np.testing.assert_allclose, rtol=1e-6), found, norms(values))


@pytest.mark.parametrize("distinct", [1, 3, 7])
def test_values_that_repeat_are_evaluated_once(distinct):
    """What follows the first chunks is never looked at."""
    values = np.random.default_rng(0).normal(size=(distinct, 2)).astype(np.float32)
    repeated = values[np.arange(7) % distinct]
    poisoned = np.where(np.arange(7)[:, None] < -(-distinct // 3) * 3, repeated, np.nan)
    found = jax.jit(lambda many: in_chunks(norms, poisoned, 3, many))(jnp.array(distinct))
    jax.tree.map(partial(np.testing.assert_allclose, rtol=1e-6), found, norms(repeated))


def test_the_variance_of_clusters_is_that_of_leaving_each_out():
    """Of a linear model, fitted anew without each of four clusters of different sizes."""
    windows, design = pushes(35, noise=0.1)
    of = np.arange(35) // 10
    field = hj.fit_least_squares(Push(np.zeros(2, np.float32)), windows).field
    data = np.asarray(windows.x).reshape(35, -1)
    refits = [np.linalg.lstsq(design[of != g].reshape(-1, 2), data[of != g].ravel())[0] for g in range(4)]
    expected = 3 * np.cov(np.array(refits).T, ddof=0)
    np.testing.assert_allclose(hj.covariance_of(field, windows, cluster=10), expected, rtol=1e-3)
