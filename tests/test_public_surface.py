"""Whatever the public functions are given, they give a finite result or refuse it in one line, as a ValueError.

`CASES=full pytest -n 0 tests/test_public_surface.py tests/test_public_files.py` tries 10 000 cases; without it it is
some 200, in seconds. Both are the same every time.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pendulum import pendulum, swings
from surface import cases, is_finite, odd, outcome, spoiled

import hybrid_jax as hj
from hybrid_jax import metrics
from hybrid_jax.adaptation import ridge
from hybrid_jax.estimation import fit_least_squares, uncertainty
from hybrid_jax.export import export_program, load_program
from hybrid_jax.networks.mlp import NORMS, InputScaling
from hybrid_jax.sim import SOURCE, Domain, SplitSpec, random_flights
from hybrid_jax.status import Status
from hybrid_jax.training.loss import residual_norm
from hybrid_jax.trajectories import check, concatenate, split, windows_of

KEY = jax.random.key(0)
BODY, SWING = hj.rigid_body(hj.IRIS), pendulum()
NETWORK = hj.residual_network(2, 1, KEY, hidden=4)
MIXED = hj.Hybrid(SWING, NETWORK)
WINDOWS = jax.tree.map(np.asarray, swings(12, steps=3))


def states(kind, shape):
    """Sound states and inputs of a rigid body or a pendulum."""
    rng = np.random.default_rng(0)
    n, m = {"body": (13, 4), "swing": (2, 1)}[kind]
    x0 = rng.normal(size=(*shape, n)).astype(np.float32)
    u = rng.normal(size=(*shape, 3, m)).astype(np.float32)
    if kind == "body":
        x0[..., 3:7] /= np.linalg.norm(x0[..., 3:7], axis=-1, keepdims=True)
        u = 20 * u + np.float32(hj.IRIS.hover_speed)
    return x0, u


FLOWN = {"body": BODY, "swing": SWING}


@st.composite
def flights(draw, shapes=((), (3,))):
    """A kind of field, and x0 and u for it, of n windows or of one, both perhaps spoiled."""
    kind = draw(st.sampled_from(sorted(FLOWN)))
    x0, u = states(kind, draw(st.sampled_from(shapes)))
    harm = draw(st.sampled_from([0.0, 0.6]))
    return kind, draw(spoiled(x0, harm)), draw(spoiled(u, harm))


@cases(0.17)
@given(flights(), odd(0.01, 0.01, np.float32(0.01), np.array(0.01)), st.sampled_from([*FLOWN, None]))
def test_a_prediction_is_finite_or_refused(flight, dt, other):
    kind, x0, u = flight
    found = outcome(hj.Model(FLOWN[other or kind]).predict, x0, u, dt)
    assert found is None or is_finite(found)


@st.composite
def windows(draw):
    """Windows of a pendulum, perhaps spoiled."""
    harm = draw(st.sampled_from([0.0, 0.0, 0.4]))
    parts = (draw(spoiled(part, harm)) for part in (WINDOWS.x0, WINDOWS.u, WINDOWS.x))
    return hj.Trajectories(*parts, draw(odd(0.05)) if harm else 0.05)


@cases(0.1)
@given(windows())
def test_windows_that_pass_the_check_are_whole(found):
    if outcome(check, found) is None:
        return
    assert found.x.shape == (len(found), found.horizon, found.x0.shape[1])
    assert is_finite(jax.tree.map(lambda part: jnp.asarray(part, np.float32), found))
    assert hash(found.dt) is not None
    assert len(list(found)) == len(found)  # a loop over them ends


@cases(0.08)
@given(
    windows(),
    windows(),
    odd(0.01),
    st.fixed_dictionaries(
        {},
        optional={
            "min_epochs": odd(0, 2),
            "patience": odd(0, 2),
            "max_epochs": odd(1, 3),
            "regulariser_weight": odd(0.0, 1e-3),
            "settings": st.sampled_from([hj.Settings(4, residual_norm), hj.Settings(4), hj.Settings(13), None, 4, "4"]),
        },
    ),
    st.sampled_from([KEY, jax.random.PRNGKey(0), 0, None, jax.random.split(KEY, 2), "key"]),
    st.sampled_from([MIXED, SWING, BODY]),
)
def test_a_fit_leaves_a_finite_field_or_is_refused(train, validation, rate, rules, key, field):
    rules = {"max_epochs": 2, "settings": hj.Settings(4)} | rules
    found = outcome(hj.fit, field, train, validation, key, rates=rate, **rules)
    assert found is None or (is_finite(found.best) and (found.status == Status.DIVERGED or np.isfinite(found.best_mse)))


@pytest.mark.parametrize("rates", [(1, 2), hj.Hybrid(1.0, "fast"), hj.Hybrid(np.nan, 1.0), {"physics": 1.0}])
def test_rates_that_do_not_go_with_the_field_are_refused(rates):
    with pytest.raises(ValueError, match=r"^rates must be"):
        hj.fit(MIXED, WINDOWS, WINDOWS, KEY, rates=rates, settings=hj.Settings(4))


# Name → a function of windows; each finite or refused, if the windows are those of a pendulum of moderate speed.
OF_WINDOWS = {
    "fit_least_squares": lambda w, n: fit_least_squares(SWING, w, max_steps=n).field,
    "adapt": lambda w, n: hj.adapt(SWING, w).field,
    "covariance": lambda w, n: uncertainty.covariance_of(SWING, w, chunk=n),
    "linear": lambda w, n: ridge.linear_residual(SWING, w, n),
    "last layer": lambda w, n: ridge.last_layer(MIXED, w, n),
    "adapted": lambda w, n: ridge.fit_ridge(ridge.last_layer, MIXED, w, WINDOWS, (1.0, n)),
    "mse": lambda w, n: metrics.rollout_mse(SWING, w, n), "split": lambda w, n: split(check(w), n),
    "windows_of": lambda w, n: check(windows_of(w.u[0], w.u[0, :-1], w.dt, steps=n)),
    "concatenate": lambda w, n: check(concatenate([w, WINDOWS])), "subset": lambda w, n: check(w[:2]),
}  # fmt: skip


@cases(0.1)
@given(windows(), odd(1, 2), st.sampled_from(sorted(OF_WINDOWS)))
def test_what_is_made_of_windows_is_finite_or_refused(found, number, name):
    whole = outcome(check, found) is not None
    if name in ("windows_of", "concatenate", "subset") and not whole:
        return  # these rearrange arrays of any content; `check` is what looks at it
    made = outcome(OF_WINDOWS[name], found, number)
    moderate = whole and max(np.abs(part).max(initial=0) for part in (found.x0, found.u, found.x)) < 1e4
    assert made is None or is_finite(made) or not moderate


@cases(0.05)
@given(odd(1, 2), odd(1, 2), odd(1, 3), st.sampled_from([*NORMS, "group", None, 1, []]), odd(1.0), odd(0.0))
def test_a_network_is_made_or_refused(state_size, input_size, hidden, norm, scale, offset):
    scaling = outcome(InputScaling, offset, scale)
    network = outcome(hj.residual_network, state_size, input_size, KEY, hidden=hidden, norm=norm, scaling=scaling)
    if network is not None:
        assert is_finite(network)
        assert is_finite(network(jnp.ones(state_size), jnp.ones(input_size)))


@cases(0.04)
@given(odd(1, 2.0), odd(0.4), st.sampled_from([(), None, "drag", (1,)]), odd(1, 5), odd(10), odd(0), odd(1.0))
def test_the_simulator_refuses_what_makes_no_domain_or_flight(vehicle, drag, forces, windows, steps, flights, seconds):
    assert outcome(Domain, "mine", vehicle) is None
    domain = outcome(Domain, "mine", drag_coefficient=drag, forces=forces)
    assert domain is None or is_finite(domain.quadrotor().parameters)
    spec = outcome(SplitSpec, windows, steps)
    assert spec is None or spec.windows * spec.steps > 0
    assert outcome(random_flights, SOURCE, flights, seconds, "no key") is None


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("programs")


@pytest.fixture(scope="module")
def programs(folder):
    """Whether it is of a batch → a program of a step."""
    for batched in (False, True):
        export_program(folder / f"{batched}.npz", SWING, 0.05, state_size=2, input_size=1, batched=batched)
    return {batched: load_program(folder / f"{batched}.npz") for batched in (False, True)}


@cases(0.1)
@given(st.booleans(), st.sampled_from([(), (3,)]), st.data())
def test_a_program_answers_with_what_is_finite_or_refuses(programs, batched, shape, data):
    x, u = (data.draw(spoiled(a[..., 0, :] if a.ndim > len(shape) + 1 else a)) for a in states("swing", shape))
    found = outcome(programs[batched], x, u)
    assert found is None or is_finite(found) or max(np.abs(x).max(), np.abs(u).max()) > 1e4
