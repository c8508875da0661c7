"""CasADi's function of a field is the field: its values, its derivatives, its steps."""

from functools import partial

import fields
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from fields import KEY, SIZES, SOME_SLOW, body, double, field_of, samples, solved
from surface import refusal

from hybrid_jax import Hybrid, residual_network, rollout
from hybrid_jax.export import casadi_function
from hybrid_jax.networks import smoothed

ca = pytest.importorskip("casadi")


close = partial(fields.close, tolerance=1e-12)  # a few hundred operations of 1e-16 each


def jacobian(function):
    x, u = function.sx_in()
    return ca.Function("jacobian", [x, u], [ca.jacobian(function(x, u), ca.vertcat(x, u))])


@pytest.mark.parametrize("name", SOME_SLOW)
def test_it_has_the_values_and_the_derivatives_of_the_field(name):
    """The derivatives along a random direction: one wrong entry of the Jacobian shows in it."""
    function = casadi_function(field_of(name), **SIZES)
    slopes, (dx, du) = jacobian(function), (part[0] for part in samples(seed=2))
    with jax.enable_x64(True):
        field = double(field_of(name))
        for x, u in zip(*samples(2), strict=True):
            value, slope = jax.jvp(field, (jnp.asarray(x), jnp.asarray(u)), (jnp.asarray(dx), jnp.asarray(du)))
            close(function(x, u), value)
            close(slopes(x, u) @ np.concatenate([dx, du]), slope)


def test_inputs_and_outputs_have_names_and_sizes_of_another_system_too():
    function = casadi_function(residual_network(2, 1, KEY, hidden=4), state_size=2, input_size=1, name="pendulum")
    assert str(function) == "pendulum:(x[2],u)->(xdot[2]) SXFunction"
    assert casadi_function(body(), 0.01).name_out() == ["xnext"]
    assert function(x=[0.1, 0.2], u=0.3)["xdot"].shape == (2, 1)


def test_smooth_takes_the_place_of_relu_alone():
    relu, tanh = (Hybrid(body(), residual_network(13, 4, KEY, hidden=5, activation=name)) for name in ("relu", "tanh"))
    x, u = (part[0] for part in samples())
    with jax.enable_x64(True):
        for field, smooth in ((relu, smoothed(relu, 30.0)), (tanh, tanh)):
            close(casadi_function(field, smooth=30.0)(x, u), double(smooth)(x, u))
            close(casadi_function(field, 0.02, smooth=30.0)(x, u), rollout(double(smooth), x, u[None], 0.02)[0])
    assert abs(casadi_function(relu)(x, u) - casadi_function(relu, smooth=30.0)(x, u)).full().max() > 1e-6


def everything(x, u):
    """What no field of the library needs and one of a user's own may."""
    matrix = jnp.outer(x, u)
    batch = jnp.stack([matrix, 2 * matrix])
    parts = [
        jnp.linalg.norm(x), jnp.einsum("bij,bkj->b", batch, batch[:, ::-1]).sum(),
        jnp.cumsum(x)[-2] + jnp.prod(u) + jnp.max(x) + jnp.min(u),
        jnp.arctan2(x[0], x[1]) + jnp.clip(x[2], -0.1, 0.1) + jnp.sign(x[3]),
        jax.nn.sigmoid(x[4]) + jax.nn.softplus(x[0]) + jax.nn.gelu(x[1], approximate=False),
        jnp.where((x[0] > 0) & ~(x[1] > 0) | (u[0] < 500), x[2], u[1]),
        jnp.linalg.matrix_power(matrix[:4], 3).sum() + jnp.pad(x, 2).sum() + jnp.tile(x, 3)[20],
        x[jnp.array([0, 0, 5])].sum() + x.at[jnp.array([1, 1])].add(x[2]).sum(),
        (x**3).sum() + jnp.abs(x[0]) ** 1.5 + 2.0 ** x[1] + jnp.log1p(x[2] ** 2) + jnp.expm1(x[3]),
        jax.checkpoint(jnp.sin)(x[0]) + jnp.roll(x, 2)[0] + jax.lax.dynamic_slice(x, (3,), (2,)).sum(),
        sum(jnp.split(x[:12], 3))[0] + jnp.remainder(x[0], 1.3), jnp.floor(x[0]), jnp.mean(x) + jnp.var(x),
    ]  # fmt: skip
    return jnp.stack(parts)


def test_a_field_of_one_s_own_may_use_what_casadi_has():
    function = casadi_function(everything, **SIZES)
    with jax.enable_x64(True):
        for x, u in zip(*samples(), strict=True):
            expected = np.asarray(jax.jit(everything)(x, u))
            np.testing.assert_allclose(np.asarray(function(x, u)).ravel(), expected, rtol=1e-12)


def looked_up(x, u):
    return x * jnp.arange(3.0)[jnp.clip(x[0].astype(int), 0, 2)]


def looped(x, u):
    return jax.lax.fori_loop(0, 3, lambda _, y: y / 2, x)


@pytest.mark.parametrize(("field", "said"), [(solved, "'lu'"), (looked_up, "to int64"), (looped, "'scan'")])
def test_an_operation_that_casadi_has_not_is_named_and_what_makes_no_sense_refused(field, said):
    with pytest.raises(ValueError, match=rf"^field: its .*{said}.* has no counterpart in CasADi$"):
        casadi_function(field, **SIZES)
    refusal(lambda: casadi_function(body(), name="1 f"), "name must be a valid")
    refusal(lambda: casadi_function(solved), "state_size must be given: function does not know its size")
