"""A state space changes states and compares them; a field on a manifold of a user's own is learned as any other."""

import re
import warnings
from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from pendulum import pendulum, whirling
from systems import SYSTEMS, windows, wrap

import hybrid_jax as hj
from hybrid_jax.dynamics.base import state_space
from hybrid_jax.dynamics.rigid_body import RIGID_BODY_SPACE, rigid_body
from hybrid_jax.dynamics.window_checks import check_windows
from hybrid_jax.state_space import Angle, Attitude, Quantity, StateSpace

pytestmark = pytest.mark.usefixtures("double_precision")  # laws hold to round-off
CIRCLE = whirling().state_space
SPACES = {"line": StateSpace((Quantity("place", 2, "m"),)), "circle": CIRCLE, "body": RIGID_BODY_SPACE}
SPACES |= {"joint": StateSpace((Attitude("attitude"), Angle("angles", 2), Quantity("speed")))}


@pytest.fixture(params=SPACES)
def space(request):
    return SPACES[request.param]


def whirls(count):
    """Windows of a pendulum that starts anywhere, at up to 8 rad/s."""
    starts = np.random.default_rng(0).uniform(-1, 1, (count, 2)) * [np.pi, 8.0]
    made = windows(whirling(), lambda *_: starts, lambda rng, shape: np.zeros((*shape, 1)), 0.05, count, seed=0)
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, float), made)


def states(space, count=2, seed=0):
    return [space.normalise(4 * x) for x in jax.random.normal(jax.random.key(seed), (count, space.size))]


def test_a_difference_leads_from_one_state_to_the_other_and_derivatives_are_those_of_the_tangent_space(space):
    for seed in range(5):
        y, x = states(space, seed=seed)
        change = space.difference(y, x)
        assert change.shape == (space.tangent_size,)
        reached = space.retract(x, change)
        np.testing.assert_allclose(space.nearest(y, reached), reached, atol=1e-12)
        for same, one in ((space.retract(x, 0 * change), x), (space.nearest(x, x), x)):
            np.testing.assert_allclose(same, one, atol=1e-12)
        for same in (space.nearest(y, x), space.normalise(space.nearest(y, x))):
            np.testing.assert_allclose(space.difference(same, y), 0, atol=1e-7)
    x, _ = states(space)
    slope = jax.jacfwd(lambda change: space.difference(space.retract(x, change), x))(jnp.zeros(space.tangent_size))
    np.testing.assert_allclose(slope, np.eye(space.tangent_size), atol=1e-7)


def test_further_numbers_and_features_have_names_of_their_own_and_a_field_inside_another_says_the_state():
    padded = RIGID_BODY_SPACE.padded(15)
    assert (padded.size, padded.names[-3:], padded.units[-3:]) == (15, ("wz", "13", "14"), ("rad/s", "", ""))
    assert StateSpace().padded(2).names == ("0", "1")
    assert not any(isinstance(one, Attitude) for one in RIGID_BODY_SPACE.padded(4).quantities)
    with pytest.raises(ValueError, match="labels of pair must be one for each of size=2, got"):
        Quantity("pair", 2, labels=("one",))
    wheels = StateSpace((Angle("angle", 2, labels=("left", "right")), Quantity("rate", 2, labels=("left", "right"))))
    found = wheels.features(np.arange(20.0).reshape(5, 4), np.zeros((5, 1)))
    assert [*found] == ["angle left", "angle right", "rate left", "rate right", "u[0]"]
    assert {*map(len, hj.Grid((12,), 1.0, 2).state_space.features(x := np.zeros((5, 24)), x[:, :0]).values())} == {60}
    body = rigid_body(hj.IRIS)
    for field in (hj.Hybrid(body, pendulum()), hj.Frozen(body), lambda x, u: x):
        assert (state_space(field) is RIGID_BODY_SPACE) == hasattr(field, "state_space")
    assert state_space(body, 2) == StateSpace().padded(2)


def test_windows_of_the_same_states_are_the_same_windows_and_a_quaternion_may_change_its_sign():
    data = whirls(20)
    jumping = wrap(CIRCLE, data)
    joined = check_windows(whirling(), jumping)
    assert check_windows(whirling(), joined) is joined
    with pytest.warns(UserWarning, match=r"^windows: x\[0\] jumps by about 2π in \d+ of 20 windows"):
        assert check_windows(pendulum(), jumping) is jumping
    turns = (joined.x - data.x) / (2 * np.pi)
    np.testing.assert_allclose(turns[..., 0], np.broadcast_to(turns[:, :1, 0].round(), turns.shape[:2]), atol=1e-6)
    x = np.tile(np.eye(13)[3], (1, 4, 1))
    data = hj.Trajectories(x[:, 0], np.zeros((1, 4, 4)), x, 0.01)
    flipped = data.x.copy()
    flipped[:, 1:3, 3:7] *= -1
    joined = check_windows(rigid_body(hj.IRIS), hj.Trajectories(data.x0, data.u, flipped, data.dt))
    np.testing.assert_array_equal(joined.x, data.x)


def test_a_filter_follows_an_angle_through_its_turns():
    dt, field, truth = 0.02, whirling(0.6), whirling(0.5)
    online = hj.OnlineAdaptation(field, dt=dt, noise=1e-3)
    path = hj.rollout(truth, jnp.array([0.0, 12.0]), jnp.zeros((300, 1)), dt)
    assert path[-1, 0] > 6 * np.pi
    update, state = eqx.filter_jit(online.update), online.begin(jnp.array([0.0, 12.0]))
    for x in path:
        state = update(state, CIRCLE.normalise(x), jnp.zeros(1))
    assert abs(state.x[0]) < np.pi + 0.1
    assert online.model(state).log_length == pytest.approx(np.log(0.5), abs=1e-3)


# States that are the rate of another one.
RATES = {"pendulum": {1: "x[0]"}, "circle": {1: "angle"}, "car": {5: "x[2]"}, "ring_convolution": {}}
RATES["multirotor"] = {7: "position[0]", 8: "position[1]", 9: "position[2]", 10: "attitude[0]", 12: "attitude[2]"}


@pytest.mark.parametrize("name", RATES)
def test_a_rate_in_another_unit_than_its_state_is_said_and_no_right_one(name):
    system = SYSTEMS[name]()
    with warnings.catch_warnings(action="error"):
        for windows in (system.train, system.target, system.test):
            check_windows(system.model, windows)
    for state, of in RATES[name].items():
        for unit in (180 / np.pi, 0.1):
            factor = np.ones(system.test.x0.shape[1], np.float32)
            factor[state] = unit
            wrong = replace(system.test, x0=system.test.x0 * factor, x=system.test.x * factor)
            said = rf"windows: x\[{state}\] is (\S+) times the rate of {re.escape(of)}: check their units, and dt"
            with pytest.warns(UserWarning, match=said) as caught:
                check_windows(system.model, wrong)
            assert float(re.findall(said, str(caught[0].message))[0]) == pytest.approx(unit, rel=0.02)
