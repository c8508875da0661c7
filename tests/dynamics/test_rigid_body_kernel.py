"""The kernels of a rigid body beside a network do what JAX does, and JAX does it where they do not serve."""

import sys
from dataclasses import replace
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from systems import ODD

from benchmarks.subjects import SETTINGS, make_windows, training_runs, untrained
from hybrid_jax import native
from hybrid_jax.dynamics.base import train_batch, train_sum
from hybrid_jax.dynamics.rigid_body import LEARNED, ForcedBody, RigidBody
from hybrid_jax.sweep.lanes import lane
from hybrid_jax.sweep.training import sweep
from hybrid_jax.vehicle import IRIS

bodies = sys.modules["hybrid_jax.dynamics.rigid_body"]  # the package has a function of that name
HEXACOPTER = replace(
    ODD,
    rotor_positions=tuple((float(0.2 * np.cos(angle)), float(0.3 * np.sin(angle))) for angle in 0.1 + np.arange(6)),
    spin=(1.0, -1.0) * 3,
)
VEHICLES = {"iris": IRIS, "odd": ODD, "six rotors": HEXACOPTER}

needs_kernels = pytest.mark.skipif(native.prefix() is None, reason=native.status())


def body(vehicle, kind=RigidBody):
    return kind(dict(zip(LEARNED, jnp.array([0.3, -0.4, 0.1]), strict=True)), vehicle)


def arrays_of(vehicle, b, lanes=()):
    """θ_p, x, u and a residual, and a derivative of the sum."""
    rng = np.random.default_rng(b)
    ix, iy, _ = vehicle.inertia
    theta = np.multiply((ix, iy, vehicle.thrust_coefficient), rng.uniform(0.7, 1.4, (*lanes, 3)))
    x, residual, d_out = rng.normal(scale=2, size=(3, *lanes, 13, b))
    u = rng.uniform(0, 1100, (*lanes, vehicle.rotors, b))
    arrays = *np.moveaxis(theta, -1, 0), x, u, residual, d_out
    *arrays, d_out = (array.astype(np.float32) for array in arrays)
    return arrays, d_out


def both_ways(function, arrays, d_out):
    y, pullback = jax.vjp(function, *arrays)
    return y, *pullback(d_out)


def one_by_one(vehicle, arrays, d_out):
    """Value and derivatives of each column, in double precision: columns last, θ_p's not summed."""
    arrays, d_out = jax.tree.map(lambda part: part.astype(float), (arrays, d_out))
    column = partial(both_ways, partial(bodies._plain_sum, vehicle))
    return jax.vmap(column, ([None] * 3 + [-1] * 3, -1), -1)(arrays, d_out)


@needs_kernels
@pytest.mark.parametrize("b", [16, 33, 100])
@pytest.mark.parametrize("vehicle", VEHICLES.values(), ids=VEHICLES)
def test_values_and_derivatives_are_those_of_jax_in_double_precision(vehicle, b):
    arrays, d_out = arrays_of(vehicle, b)
    found = jax.jit(partial(both_ways, partial(bodies._kernel_sum, vehicle)))(arrays, d_out)
    with jax.enable_x64(True):
        exact = one_by_one(vehicle, arrays, d_out)
        for one, other in zip(found, exact, strict=True):
            # Of each row, and of the terms of each sum: some ten operations, each of which is rounded at 6e-8.
            if one.ndim:
                np.testing.assert_array_less(abs(one - other).max(1), 1e-6 * abs(other).max(1) + 1e-30)
            else:
                assert abs(one - other.sum()) < 1e-6 * abs(other).sum()


@needs_kernels
def test_a_lane_is_the_same_alone_to_the_bit():
    lanes = arrays_of(HEXACOPTER, 40, lanes=(2, 3))
    function = partial(both_ways, partial(bodies._kernel_sum, HEXACOPTER))
    together = jax.jit(jax.vmap(jax.vmap(function)))(*lanes)
    alone = jax.jit(function)(*jax.tree.map(lambda part: part[1, 2], lanes))
    for one, other in zip(together, alone, strict=True):
        np.testing.assert_array_equal(one[1, 2], other)


@needs_kernels
def test_a_second_derivative_is_that_of_jax():
    arrays, d_out = arrays_of(ODD, 16)
    plain = partial(bodies._plain_sum, ODD)

    def curvature(function, x):
        slope = jax.grad(lambda x: jnp.sum(d_out * jnp.square(function(*arrays[:3], x, *arrays[4:]))))
        return jax.grad(lambda x: jnp.sum(jnp.square(slope(x))))(x)

    found, expected = (curvature(function, arrays[3]) for function in (partial(bodies._kernel_sum, ODD), plain))
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-5 * np.abs(expected).max())


@needs_kernels
@pytest.mark.parametrize("kind", [RigidBody, ForcedBody])
def test_learned_parameters_get_the_derivative_of_plain_jax(kind, monkeypatch):
    (*_, x, u, residual), d_out = arrays_of(ODD, 40)

    def slopes():
        return jax.tree.leaves(both_ways(train_sum, (body(ODD, kind), x, u, residual), d_out))

    found = slopes()
    monkeypatch.setattr(native, "prefix", lambda: None)
    for one, other in zip(found, slopes(), strict=True):
        # A sum of forty terms, which cancel in part.
        np.testing.assert_allclose(one, other, rtol=0, atol=1e-5 * np.abs(other).max())


@needs_kernels
def test_a_state_that_is_no_number_shows_in_the_result():
    arrays, d_out = arrays_of(ODD, 20)
    arrays[3][4, 17] = np.nan
    y, *d_theta, d_x, _, _ = both_ways(partial(bodies._kernel_sum, ODD), arrays, d_out)
    assert (np.isnan(y).any(0) == (np.arange(20) == 17)).all()
    assert (np.isnan(d_x).any(0) == (np.arange(20) == 17)).all()
    assert np.isnan(d_theta[2])


def calls(function, *arguments):
    return "rigid_body_forward" in jax.jit(function).lower(*arguments).as_text()


@needs_kernels
def test_kernels_serve_beside_a_network_alone():
    # A rollout of physics alone is one kernel of XLA, which calls would break up.
    hybrid = untrained("hybrid", hidden=16)
    (*_, x, u, _), _ = arrays_of(IRIS, 20)
    assert calls(train_batch, hybrid, x, u)
    assert not calls(train_batch, hybrid.physics, x, u)


class Own(RigidBody):
    def train_batch(self, x, u):
        return 2 * super().train_batch(x, u)


OTHER = {
    "columns": (body(ODD), lambda part: part[:, :9]),
    "precision": (body(ODD), lambda part: part.astype(np.float16)),
    "one's own": (body(ODD, Own), lambda part: part),
}


@pytest.mark.parametrize(("field", "change"), OTHER.values(), ids=OTHER)
def test_others_are_plain_jax(field, change):
    (*_, x, u, residual), _ = arrays_of(ODD, 20)
    x, u, residual = map(change, (x, u / 100, residual))
    np.testing.assert_array_equal(train_sum(field, x, u, residual), field.train_batch(x, u) + residual)


def test_arrays_that_do_not_fit_are_refused():
    (*_, x, u, residual), _ = arrays_of(ODD, 20)
    with pytest.raises((TypeError, ValueError)):
        train_sum(body(ODD), x, u[:, :4], residual)


@needs_kernels
@pytest.mark.slow
def test_a_lane_of_a_sweep_is_the_same_run_alone_to_the_bit():
    states, plans = training_runs("hybrid", 2, 100, max_epochs=3, hidden=16)
    windows = make_windows(100, 2)

    def swept(which):
        chosen = (lane(tree, np.array(which)) for tree in (states, plans))
        return sweep(*chosen, windows, windows, SETTINGS, width=1)

    together, alone = swept([0, 1]), swept([1])
    for one, other in zip(
        *(jax.tree.leaves(eqx.filter(run.field, eqx.is_array)) for run in (together, alone)), strict=True
    ):
        np.testing.assert_array_equal(one[1], other[0])
