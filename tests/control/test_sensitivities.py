"""The Jacobian of a step equals that of autodiff, for any field."""

from dataclasses import replace
from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from choices import slow

import hybrid_jax as hj
from hybrid_jax.control import advance
from hybrid_jax.control.sensitivities import advance_lagged, advance_with_jacobian, condensed, stage_shares, step_of
from hybrid_jax.dynamics import ConstantDisturbance, Frozen
from hybrid_jax.networks.mlp import InputScaling, LinearResidual
from hybrid_jax.networks.views import multirotor_network

DT = 0.05
SCALING = InputScaling(hj.IRIS.hover_speed, hj.IRIS.hover_speed / 10)


def network(inputs="all", outputs="all", norm="batch", linear=False):
    known = {"hidden": 8, "scaling": SCALING, "vehicle": hj.IRIS}
    made = multirotor_network(key=jax.random.key(1), inputs=inputs, outputs=outputs, norm=norm, linear=linear, **known)
    return jax.tree.map(lambda leaf: leaf + 0.3 + 0.2 * jnp.sin(jnp.arange(leaf.size)).reshape(leaf.shape), made)


class Spun(hj.AbstractVectorField):
    def __call__(self, x, u):
        return jnp.sin(x) + jnp.concatenate([x[5:9] * u / 600, x[:9]])


@cache
def body():
    return hj.RigidBody({"Ix": jnp.asarray(0.1), "Iy": jnp.asarray(-0.2), "k": jnp.asarray(0.05)}, hj.IRIS)


def invariant():
    forced = replace(body(), wrench=True)
    return hj.Hybrid(forced, network("near_ground", "rotors", "none", linear=True))


FIELDS = {
    "physics": body, "paper": lambda: hj.Hybrid(body(), network()),
    "layer norm": lambda: hj.Hybrid(body(), network(norm="layer")),
    "no x, y": lambda: hj.Hybrid(body(), network("no_xy", norm="none")),
    "body frame": lambda: hj.Hybrid(body(), network("body", "accelerations")),
    "invariant, disturbed": lambda: hj.Hybrid(invariant(), ConstantDisturbance(jnp.ones(6))),
    "frozen": lambda: hj.Hybrid(body(), Frozen(LinearResidual(jnp.ones((13, 17)) / 50, jnp.ones(13)))), "user": Spun,
}  # fmt: skip


def samples(count=3):
    rng = np.random.default_rng(0)
    x = rng.normal(size=(count, 13))
    x[:, 2] = rng.uniform(0.2, 1.0, count)
    x[:, 3:7] /= np.linalg.norm(x[:, 3:7], axis=1, keepdims=True)
    return x, rng.uniform(500, 800, (count, 4))


LONG_TO_COMPILE = ("paper", "layer norm", "body frame", "invariant, disturbed")


@pytest.mark.parametrize("name", [name for name in FIELDS if name not in LONG_TO_COMPILE] + slow(*LONG_TO_COMPILE))
def test_jacobian_of_a_step_equals_autodiff(name):
    def both(field, x, u):
        expected = jnp.concatenate(jax.jacfwd(partial(advance, field), argnums=(0, 1))(x, u, DT), axis=1)
        return advance_with_jacobian(field, x, u, u, 0.0, DT), (advance(field, x, u, DT), expected)

    with jax.enable_x64(True):
        field = jax.tree.map(lambda leaf: jnp.asarray(leaf, float), FIELDS[name]())
        x, u = map(jnp.asarray, samples())
        found, expected = jax.jit(jax.vmap(both, in_axes=(None, 0, 0)))(field, x, u)
        for one, other in zip(found, expected, strict=True):
            np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-9 * float(jnp.abs(other).max()))


@pytest.mark.parametrize("lag", [0.005, 0.03, 0.2, 4.9, 5.1])
def test_a_step_is_exact_for_a_chain_of_integrators_of_a_lagging_input(lag):
    start, dt = jnp.array([0.3, -0.2, 0.1]), DT
    with jax.enable_x64(True):
        shares = stage_shares(lag, dt)
        found = step_of(lambda x, f: jnp.stack([x[1], x[2], f]), jnp.asarray(start, float), shares, dt)
    s = np.linspace(0, dt, 20_001)
    moments = [np.trapezoid((dt - s) ** k / (1, 1, 2)[k] * np.exp(-s / lag), s) for k in (2, 1, 0)]
    a, b, c = np.asarray(start, float)
    expected = np.array([a + b * dt + c * dt**2 / 2, b + c * dt, c]) + moments
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9)


@pytest.mark.parametrize("lag", [0.04, 0.0])
def test_derivatives_by_commands_of_lagging_rotors_equal_autodiff(lag):
    dt, body = 0.05, FIELDS["physics"]()

    def states(commands, x, speeds):
        def interval(start, command):
            start = advance_lagged(body, *start, command, lag, dt)
            return start, start[0]

        return jax.lax.scan(interval, (x, speeds), commands)[1]

    @jax.jit
    def both(commands, x, speeds):
        path = jnp.concatenate([x[None], states(commands, x, speeds)])
        found = condensed(body, path[:-1], speeds, commands, lag, dt)
        return found, jax.jacfwd(states)(commands, x, speeds)

    with jax.enable_x64(True):
        x, u = map(jnp.asarray, samples())
        found, expected = both(u, x[0], u[1])
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-6 * np.abs(np.asarray(expected)).max())
