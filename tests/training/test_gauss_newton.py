"""Gauss–Newton over all parameters of a field."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from pendulum import pendulum, swings

import hybrid_jax as hj
from hybrid_jax.integrate import RK4
from hybrid_jax.training.gauss_newton import PENALTIES
from hybrid_jax.training.loss import REGULARISERS, Minibatch

KEY = jax.random.key(0)


def field(norm="none"):
    return hj.Hybrid(pendulum(), hj.residual_network(2, 1, KEY, hidden=4, norm=norm, activation="tanh"))


def test_it_goes_far_below_what_adam_reaches():
    windows = swings(30, steps=5)
    start = hj.with_scaling(field(), windows)
    found = hj.fit_gauss_newton(start, windows, max_steps=20)
    adam = hj.fit(start, windows, windows, KEY, max_epochs=20, min_epochs=20)
    assert found.loss < 0.1 * float(adam.best_mse)
    assert found.steps <= 20


@pytest.mark.parametrize("name", ["residual_norm", "trajectory_correlation"])
def test_rows_are_the_root_of_the_penalty(name):
    windows = swings(3, steps=4)
    model = hj.with_scaling(field(), windows)
    own = []
    for i in range(3):
        window = jax.tree.map(jnp.asarray, windows[i])
        predicted = hj.rollout(model, window.x0, window.u, window.dt)
        own.append(float(jnp.sum(jnp.square(PENALTIES[name](model, predicted, window, RK4())))))
    batch = Minibatch(*(jnp.moveaxis(jnp.asarray(a), 0, -1) for a in (windows.x0, windows.u, windows.x)), dt=windows.dt)
    predicted = jnp.moveaxis(hj.rollout_batch(model, windows.x0, windows.u, windows.dt), 0, -1)
    assert np.mean(own) == pytest.approx(float(REGULARISERS[name](model, batch, predicted)), rel=1e-4)


def test_a_heavy_penalty_silences_the_network():
    windows = swings(20, steps=3)
    free = hj.fit_gauss_newton(field(), windows, max_steps=8).field
    held = hj.fit_gauss_newton(field(), windows, penalty="residual_norm", weight=100.0, max_steps=8).field
    norms = [float(jnp.linalg.norm(jax.vmap(one.residual)(windows.x0, windows.u[:, 0]))) for one in (free, held)]
    assert norms[1] < 0.1 * norms[0]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"penalty": "l1"}, "penalty must be one of residual_norm"),
        ({"weight": -1.0}, "weight must be"),
        ({"scale": np.ones(3)}, "scale must"),
        ({"field": hj.residual_network(2, 1, KEY, hidden=400)}, "1 to 1000 parameters expected"),
        ({"field": lambda x, u: x}, "1 to 1000 parameters expected"),
    ],
)
def test_bad_input_ends_in_one_line(options, message):
    with pytest.raises(ValueError, match=message) as refused:
        hj.fit_gauss_newton(options.pop("field", field()), swings(5, steps=2), **options)
    assert "\n" not in str(refused.value)
