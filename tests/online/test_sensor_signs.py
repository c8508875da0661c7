"""Laws of the test of a sensor's sign, for a mass on a spring: the position tells the sign of the speed."""

import jax
import jax.numpy as jnp
import pytest

import hybrid_jax as hj
from hybrid_jax.state_space import Quantity, StateSpace

DT, NOISE = 0.01, (0.001, 0.02)


class Spring(hj.AbstractVectorField):
    stiffness: jax.Array

    @property
    def state_space(self):
        return StateSpace((Quantity("position", 1, "m"), Quantity("speed", 1, "m/s")), disturbed=slice(1, 2))

    def __call__(self, x, u):
        return jnp.stack([x[1], u[0] - self.stiffness * x[0]])


@jax.jit
def oscillating(key, sign, noise, stiffness, swing):
    """Flags in ten seconds of two swings a second, in a force that jumps; every other position is missing."""
    adaptation = hj.OnlineAdaptation(Spring(jnp.array(10.0)), DT, NOISE, 3.0, disturbance=3.0)

    def step(carry, given):
        x, state = carry
        i, white = given
        u = 12 * swing * jnp.cos(4 * jnp.pi * DT * i)[None]
        push = jnp.where(i % 200 < 100, 0.0, 2.0 * swing)
        x = hj.integrate.rk4_step(Spring(stiffness), x, u + push, DT)
        seen = jnp.array([1.0, sign]) * x + noise * jnp.array(NOISE) * white
        state = adaptation.update(state, seen.at[0].set(jnp.where(i % 2, seen[0], jnp.nan)), u)
        return (x, state), adaptation.flags(state)

    begun = jnp.zeros(2), adaptation.begin(jnp.zeros(2))
    return jax.lax.scan(step, begun, (jnp.arange(1000), jax.random.normal(key, (1000, 2))))[1]


@pytest.mark.parametrize(
    ("sign", "noise", "stiffness", "swing"),
    [(1.0, 1.0, 10.0, 1.0), (1.0, 1.7, 10.0, 0.0), (1.0, 1.0, 3.0, 1.0), (-1.0, 1.0, 10.0, 1.0)],
    ids=["force", "rest with more noise", "another stiffness", "wrong sign"],
)
def test_a_wrong_sign_is_named_and_nothing_else_is_taken_for_one(sign, noise, stiffness, swing):
    keys = jax.random.split(jax.random.key(0), 8)
    flags = jax.vmap(lambda key: oscillating(key, sign, noise, stiffness, swing))(keys)
    assert not flags.reversed[..., 0].any()
    if sign < 0:
        assert flags.reversed[:, 200:, 1].all()
        assert flags.inconsistent[:, 200:].all()
    else:
        assert not flags.reversed.any()
