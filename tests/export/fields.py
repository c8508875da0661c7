"""One field of every kind, for the tests of export, with states and inputs to try them on; made when asked for."""

from dataclasses import replace
from functools import cache, partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from choices import PAIRS
from jaxtyping import Array, Float
from systems import HOVER, flying

from hybrid_jax import IRIS, AbstractVectorField, Frozen, Hybrid
from hybrid_jax.dynamics.base import HoldState
from hybrid_jax.dynamics.rigid_body import FrozenRates, RigidBody, perturbed, rigid_body
from hybrid_jax.dynamics.terms import SHAPES, Terms
from hybrid_jax.networks.mlp import NORMS, LinearResidual, residual_network
from hybrid_jax.networks.views import multirotor_network
from hybrid_jax.vehicle import VELOCITY

KEY = np.zeros(2, np.uint32)  # jax.random.key(0)
TERMS = Terms(torque_gain=(0.9, 1.1, 0.8), drag=(0.3, 0.4, 0.1))


class Dragged(AbstractVectorField):
    """A field of one's own, which adds to some entries of another's."""

    body: RigidBody
    drag: Float[Array, ""]

    def __call__(self, x, u):
        return self.body(x, u).at[VELOCITY].add(-self.drag * x[VELOCITY])


def moved(field, size=0.1):
    """The field with every number in it away from what it began as; what is positive stays so."""
    rng = np.random.default_rng(2)
    leaves, structure = jax.tree.flatten(field)
    away = [jnp.asarray(leaf + size * rng.uniform(size=leaf.shape), leaf.dtype) for leaf in leaves]
    return jax.tree.unflatten(structure, away)


def network(**options):
    return moved(multirotor_network(IRIS, KEY, hidden=5, scaling=HOVER, **options))


def solved(x, u):
    return jnp.linalg.solve(jnp.eye(13) + jnp.outer(x, x), x)


def plain(x, u):
    return jnp.tanh(x) * jnp.where(x[2] > 0, 1.0, jnp.sum(u) / 2500)


@cache
def body():
    return perturbed(IRIS, KEY)


@cache
def per_rotor():
    return moved(rigid_body(IRIS, tuple(name for name in SHAPES if name not in ("mass", "k")), TERMS))


def with_norm(norm):
    return Hybrid(body(), moved(residual_network(13, 4, KEY, hidden=5, scaling=HOVER, norm=norm)))


def with_residual(inputs, outputs):
    return Hybrid(per_rotor(), network(inputs=inputs, outputs=outputs))


FIELDS = {
    "rigid body": body,
    "multirotor, per rotor": per_rotor,
    "multirotor": lambda: rigid_body(IRIS, (), TERMS),
    **{f"hybrid, norm {norm}": partial(with_norm, norm) for norm in NORMS},
    **{f"residual from {inputs} to {outputs}": partial(with_residual, inputs, outputs) for inputs, outputs in PAIRS},
    "linear path": lambda: Hybrid(
        moved(replace(body(), wrench=True)), network(inputs="near_ground", outputs="accelerations", linear=True)
    ),
    "linear residual": lambda: Hybrid(body(), moved(LinearResidual(jnp.zeros((13, 17)), jnp.zeros(13)))),
    "frozen rates": lambda: FrozenRates(per_rotor()),
    "frozen": lambda: Frozen(body()),
    "hold": HoldState,
    "one's own": lambda: Dragged(body(), jnp.asarray(0.3)),
    "function": lambda: plain,
}


SEEN = [f"residual from {inputs} to {outputs}" for inputs, outputs in (("all", "all"), ("body", "accelerations"))]
SLOW = [name for name in FIELDS if name.startswith("residual") and name not in SEEN]
SOME_SLOW = [pytest.param(name, marks=[pytest.mark.slow] * (name in SLOW)) for name in FIELDS]


@cache
def field_of(name):
    return FIELDS[name]()


SIZES = {"state_size": 13, "input_size": 4}


def close(found, expected, tolerance):
    """To a share of the largest entry."""
    found, expected = np.asarray(found), np.asarray(expected)
    np.testing.assert_allclose(found.reshape(expected.shape), expected, rtol=0, atol=tolerance * abs(expected).max())


def samples(count=3, seed=1):
    return flying(count, seed)


def double(field):
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, float) if eqx.is_inexact_array(leaf) else leaf, field)
