"""Laws of the extended Kalman filter of a partly measured system."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from surface import refusal

import hybrid_jax as hj
from hybrid_jax.dynamics import RandomWalk
from hybrid_jax.dynamics.base import in_double

DT = 0.05


class Mass(hj.AbstractVectorField):
    """x = (position, velocity) of a mass on a damped spring, u = (force,)."""

    stiffness: jax.Array

    def __call__(self, x, u):
        return jnp.stack([x[1], u[0] - self.stiffness * x[0] - 0.2 * x[1]])


def pushed(walk=0.0, noise=0.05):
    """The mass with a hidden push, of which only the position is measured."""
    field = hj.with_hidden(Mass(jnp.array(4.0)), RandomWalk(places=(1,)))
    known = {"start": (0.5, 0.0, 0.0), "spread": (1.0, 1.0, 1.0), "process": (0.0, 0.0, walk)}
    return hj.StateSpaceModel(field, ("force",), {"position": lambda x, u: x[0]}, **known, noise={"position": noise})


def run(kalman, samples, inputs):
    state, update = kalman.begin(samples[0]), eqx.filter_jit(kalman.update)
    for y, u in zip(samples[1:], inputs[:-1], strict=True):
        state = update(state, y, u)
    return state


@pytest.mark.parametrize("walk", [0.0, 0.3])
def test_the_filter_is_the_recursive_form_of_a_fit_of_the_whole_record(walk):
    """For a linear system both are exact, with missing samples as well."""
    rng, t = np.random.default_rng(0), np.arange(0, 1, DT)
    force, position = rng.normal(size=(len(t), 1)), 0.5 + 0.2 * rng.normal(size=(len(t), 1))
    position[10:14] = np.nan
    model = pushed(walk)
    still = eqx.tree_at(lambda model: model.field, model, hj.Frozen(model.field))
    record = hj.Record.of("run", force=(t, force), position=(t, position))
    fitted = hj.fit_records(still, [record], dt=DT, rounds=1, segment=DT if walk else None)
    with jax.enable_x64(True):
        exact = in_double(model)
        state = run(hj.ExtendedKalmanFilter(exact, DT), position, force)
    np.testing.assert_allclose(state.x, fitted.ends[0], rtol=2e-3 if walk else 1e-5, atol=1e-6)  # where the search ends


def test_a_quadrotor_s_rates_and_the_wind_are_estimated_from_position_and_attitude():
    body, wind = hj.rigid_body(hj.IRIS), jnp.array([0.5, -1.0, 0.3])
    start = jnp.zeros(16).at[2:4].set(jnp.array([2.0, 1.0]))
    field = hj.with_hidden(body, RandomWalk(places=(7, 8, 9)))
    spread = (*np.full(12, 0.3), 2.0, 2.0, 2.0)
    model = hj.StateSpaceModel(field, ("speeds",), start=start, spread=spread, process=(*np.zeros(12), 0.1, 0.1, 0.1))
    seen = replace(model.only(["position", "attitude"]), noise={"position": 0.002, "attitude": 0.004})
    rng = np.random.default_rng(0)
    speeds = (hj.IRIS.hover_speed + 10 * rng.normal(size=(150, 4))).astype(np.float32)
    true = np.asarray(hj.rollout(field, start.at[13:].set(wind), speeds, 0.01))
    samples = true[:, :7] + (rng.normal(size=(150, 7)) * np.repeat([0.002, 0.002], [3, 4])).astype(np.float32)
    state = run(hj.ExtendedKalmanFilter(seen, 0.01), samples, np.roll(speeds, -1, axis=0))
    off = np.abs(model.space.difference(state.x, true[-1]))
    assert (off < 4 * state.deviation).all()
    assert off[9:12].max() < 0.1  # body rates
    assert off[12:].max() < 0.15


def test_an_outlier_moves_a_robust_filter_less_and_bad_input_is_refused():
    samples, inputs = np.full((40, 1), 0.5, np.float32), np.full((40, 1), 2.0, np.float32)
    samples[-1] = 5.0
    usual, robust = (run(hj.ExtendedKalmanFilter(pushed(), DT, robust=r), samples, inputs).x[0] for r in (np.inf, 3.0))
    assert abs(robust - 0.5) < 0.1 * abs(usual - 0.5)
    for change, options, message in (
        ({"noise": {}}, {}, "the noise of position must be known: give it to the model, or take the model of a fit"),
        ({"spread": (1.0, np.inf, 1.0)}, {}, "spread must be finite for a filter"),
        ({}, {"dt": 0.0}, "dt must be"),
        ({}, {"substeps": 0}, "substeps must be an integer of at least 1"),
        ({}, {"robust": 0.0}, "robust must be positive"),
    ):
        model, given = replace(pushed(), **change), {"dt": DT} | options
        refusal(lambda model=model, given=given: hj.ExtendedKalmanFilter(model, **given), message)
    kalman = hj.ExtendedKalmanFilter(pushed(), DT)
    refusal(lambda: kalman.begin(np.zeros(2, np.float32)), "sample must have shape (1,), for position, got (2,)")
