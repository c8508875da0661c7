"""The experiment that tells parameters best: known optima, limits, what is predicted, and what is refused."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from surface import refusal

import hybrid_jax as hj
from hybrid_jax.control.references import reference_state
from hybrid_jax.dynamics import DisturbanceModel, Lag
from hybrid_jax.estimation.least_squares import ravel_parameters
from hybrid_jax.planning.fisher_information import information_of
from hybrid_jax.trajectories import windows_of

DT, NOISE = 0.02, 0.05
ONE = jnp.ones(1, bool)


class Pushed(hj.AbstractVectorField):
    """ẋ = b u − a x, and c, which nothing shows."""

    a: jax.Array | float = 0.0
    b: jax.Array | float = 1.0
    c: jax.Array | float = 1.0

    def __call__(self, x, u):
        return self.b * u - self.a * x + 0 * self.c


class Doubled(Pushed):
    def __call__(self, x, u):
        return (self.a + self.b) * u


def search(model, bounds, parameters=None, **options):
    given = {"seconds": 2.0, "noise": [NOISE], "window": 0.1, "dt": DT, "bandwidth": 2.0, "starts": 2}
    return hj.excitation(model, parameters, bounds, jax.random.key(0), **given | options)


FREE = hj.InputBounds(low=(-2.0,), high=(1.0,), start=(0.0,))
GAIN = Pushed(b=jnp.array(0.7))


def test_the_best_input_of_an_integrator_is_at_its_larger_limit_throughout_and_switches_in_a_box():
    """J of a sample is t u, so each window tells u² ∫t², and the larger limit is the best for all of them."""
    found = search(GAIN, FREE)
    u = jnp.full((100, 1), -2.0)
    x = jnp.concatenate([jnp.zeros((1, 1)), DT * jnp.cumsum(0.7 * u, axis=0)])
    best = jax.jit(lambda x, u: information_of(GAIN, x, u, DT, 5, jnp.array([NOISE])).covariance(ONE))(x, u)
    assert found.inputs.min() >= -2.0
    assert np.mean(found.inputs) < -1.9
    assert found.standard_errors["b"] == pytest.approx(float(jnp.sqrt(best[0, 0])), rel=0.03)
    # By hand: one window of N samples at t_i has σ²(Σt² + (Σt)²) / (Σt²)² with a noisy start; sharing samples helps.
    t = DT * np.arange(1, 6)
    alone = NOISE**2 * (np.sum(t**2) + np.sum(t) ** 2) / (4 * np.sum(t**2) ** 2)
    assert found.standard_errors["b"] < np.sqrt(alone / 20)
    # The state may move by 0.5 only, a quarter of a second at full push, so the input must turn round.
    bounds = hj.InputBounds((-2.0,), (2.0,), (0.0,), state_low=(-0.5,), state_high=(0.5,))
    found = search(GAIN, bounds, steps=100)
    assert found.margins["x0"] >= 0
    assert np.abs(found.states).max() <= 0.5
    assert np.abs(np.diff(np.sign(found.inputs[:, 0]))).sum() > 0


def test_predicted_errors_are_those_of_least_squares():
    """Of 300 noisy logs of one input, whose windows share samples; 12 % are three standard errors of a deviation."""
    model = Pushed(a=jnp.array(1.5), b=jnp.array(1.0))
    found = search(model, FREE, steps=0)
    u = jnp.asarray(found.inputs)

    def fit(key):
        log = found.states + NOISE * jax.random.normal(key, found.states.shape)
        windows = hj.Trajectories(log[:-1:5], u.reshape(-1, 5, 1), log[1:].reshape(-1, 5, 1), DT)
        field = hj.fit_least_squares(model, windows, scale=jnp.array([NOISE])).field
        return jnp.stack(jax.tree.leaves(field)[:2])

    spread = np.std(jax.jit(jax.vmap(fit))(jax.random.split(jax.random.key(0), 300)), axis=0)
    assert spread == pytest.approx([found.standard_errors[name] for name in "ab"], rel=0.12)


def test_hidden_states_are_unknown_at_the_start_of_each_window_and_a_past_adds_what_it_does_to_a_gain():
    """Their starts count as parameters, so what is left is what another value of theirs cannot explain."""
    field = hj.with_hidden(Pushed(a=jnp.array(1.5)), Lag(jnp.log(jnp.array([0.1])), places=(0,)))
    u, (theta, unravel) = jax.random.normal(jax.random.key(0), (20, 1)), ravel_parameters(field)
    x = jnp.concatenate([jnp.zeros((1, 2)), hj.rollout(field, jnp.zeros(2), u, DT)])
    gram = information_of(field, x, u, DT, 5, jnp.array([NOISE])).gram

    def predicted(both):
        starts = jnp.stack([x[:-1:5, 0], both[2:]], axis=1)
        return hj.rollout_batch(unravel(both[:2]), starts, u.reshape(4, 5, 1), DT)[..., 0].ravel() / NOISE

    jacobian = np.asarray(jax.jacfwd(predicted)(jnp.concatenate([theta, x[:-1:5, 1]])), float)
    np.testing.assert_allclose(np.linalg.inv(gram), np.linalg.inv(jacobian.T @ jacobian)[:2, :2], rtol=1e-2)
    # ẋ = b u + e with u = 1: an estimate of b is wrong by the mean of e, which a fifth of a second forgets.
    past = DisturbanceModel(GAIN, jnp.zeros((1, 2)), jnp.array([0.3, 1.0]), (0.2,), ())
    x, u = DT * 0.7 * jnp.arange(101)[:, None], jnp.ones((100, 1))
    quiet, found = (information_of(GAIN, x, u, DT, 5, jnp.array([NOISE]), past=each) for each in (None, past))
    apart = 0.1 * np.abs(np.subtract.outer(range(20), range(20)))
    added = found.covariance(ONE) - quiet.covariance(ONE)
    np.testing.assert_allclose(added, 0.3**2 * np.exp(-apart / 0.2).mean(), rtol=1e-3)


def test_a_parameter_that_nothing_excites_is_named_and_an_empty_box_refused():
    model = Pushed(b=jnp.array(0.7), c=jnp.array(2.0))
    with pytest.warns(UserWarning, match="no input excites c"):
        found = search(model, FREE, ("b", "c"), steps=0)
    assert found.standard_errors["c"] == np.inf
    assert found.parameters == ("b",)
    with pytest.warns(UserWarning, match="excites c"), pytest.raises(ValueError, match="no input excites any of c"):
        search(model, FREE, ("c",), steps=0)
    refusal(lambda: hj.FlightBounds(low=(0.0, 0.0, 2.0), high=(1.0, 1.0, 1.0)), "low must be below high")
    refusal(lambda: hj.FlightBounds(rotor_speed=(0.5, 1.2)), "two shares between 0 and 1")
    refusal(lambda: hj.InputBounds((0.0,), (1.0, 2.0), (0.0,)), "equally many")
    refusal(lambda: hj.InputBounds((0.0,), (1.0,), (0.0,), state_low=(0.0,)), "given together")


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"parameters": ("d",)}, "parameters must be names of b, got ('d',)"),
        ({"model": Doubled(jnp.array(1.0), jnp.array(2.0))}, "no input distinguishes a and b"),
        ({"bounds": hj.FlightBounds()}, "bounds must be InputBounds"),
        ({"bounds": hj.InputBounds((-1.0,), (1.0,), (2.0,), (-1.0,), (1.0,))}, "x0 leaves its limits even at rest"),
        ({"noise": None}, "noise must be given"), ({"window": 0.05}, "window must be a multiple of dt"),
        ({"bandwidth": 0.1}, "bandwidth must be from"),
    ],
)  # fmt: skip
def test_bad_input_is_refused_in_one_line(change, said):
    given = {"model": GAIN, "bounds": FREE, "steps": 0} | change
    refusal(lambda: search(**given), said)


@pytest.fixture(scope="module")
def flights():
    """A flight after no step of the search, the best of its starts, and after a few."""
    model = hj.with_disturbance(hj.rigid_body(hj.IRIS))
    given = {"seconds": 3.0, "bandwidth": 1.0, "starts": 2, "dt": DT}
    asked = model, ("Ix", "k"), hj.FlightBounds(), jax.random.key(0)
    return [hj.excitation(*asked, **given, steps=steps) for steps in (0, 40)]


@pytest.mark.slow
def test_a_flight_tells_more_than_any_start_keeps_its_limits_and_is_what_the_vehicle_can_do(flights):
    begun, found = flights
    assert found.log_det > begun.log_det
    assert all(left >= 0 for left in [*begun.margins.values(), *found.margins.values()])
    assert found.parameters == ("Ix", "k")
    for name, value in {"Ix": hj.IRIS.inertia[0], "k": hj.IRIS.thrust_coefficient}.items():
        assert 0 < found.standard_errors[name] < value
    found = flights[1]
    wanted = jax.vmap(lambda t: reference_state(found.reference, t, hj.IRIS.gravity))(jnp.asarray(found.t))
    np.testing.assert_allclose(found.states, wanted, atol=1e-3)
    windows = windows_of(found.states, found.inputs, DT, steps=1)
    predicted = hj.rollout_batch(hj.rigid_body(hj.IRIS), windows.x0, windows.u, DT)
    # Rotor speeds are held, so the plan is met to the order of the interval.
    np.testing.assert_allclose(predicted, windows.x, atol=0.02)
    assert np.abs(found.states[0] - found.states[-1]).max() < 1e-3
