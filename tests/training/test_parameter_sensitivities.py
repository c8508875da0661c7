"""The derivatives of a trajectory along all parameters of a field, against those of JAX."""

from itertools import product

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from pendulum import pendulum

import hybrid_jax as hj
from experiments.reaction_diffusion.systems import Conversion, gray_scott
from hybrid_jax.dynamics.base import as_field, ravel_learned
from hybrid_jax.integrate import RK4, integrate
from hybrid_jax.networks.grids import GridNetwork
from hybrid_jax.training.gauss_newton import with_sensitivities

KEY = jax.random.key(0)
GRID = hj.Grid((4, 5), 0.3, 2)
DIFFUSION = hj.diffusion(GRID, (0.03, 0.01))
SCOTT = gray_scott([(0.03, 0.06), (0.04, 0.05)], reacts=True)


class Falling(hj.AbstractVectorField):
    """Physics whose state shows forces elsewhere, by way of a parameter of its own."""

    log_mass: jax.Array

    def __call__(self, x, u):
        return jnp.stack([x[1], u[0] - jnp.exp(self.log_mass)])

    def apply_residual(self, x, residual):
        return jnp.stack([x[0] * residual[1], residual[1] / jnp.exp(self.log_mass)])


def network(norm="none", **options):
    return hj.residual_network(2, 1, KEY, hidden=4, norm=norm, activation="tanh", **options)


def reaction(kernel, inputs=0, **options):
    return hj.grid_network(GRID, inputs, KEY, kernel=kernel, hidden=3, **options)


def conversion():
    rate = hj.residual_network(2, 0, KEY, outputs=1, hidden=3, activation="tanh", norm="none")
    return Conversion(GridNetwork(rate, SCOTT.grid))


FIELDS = {  # and the numbers in x and u
    "pendulum": (hj.Hybrid(pendulum(), network("layer")), 2, 1),
    "batch norm": (network("batch"), 2, 1),
    "forces elsewhere": (hj.Hybrid(Falling(jnp.asarray(0.3)), network()), 2, 1),
    "pointwise": (hj.Hybrid(DIFFUSION, reaction(1)), GRID.size, 0),
    "convolution with an input": (hj.Hybrid(DIFFUSION, reaction(3, 1)), GRID.size, 1),
    "frozen physics": (hj.Hybrid(hj.Frozen(DIFFUSION), reaction(3, norm="layer")), GRID.size, 0),
    "conversion": (hj.Hybrid(SCOTT, conversion()), SCOTT.grid.size, 2),
}
# Every field with one solver, every other solver with two fields: each pair would be two programs to compile.
SOLVERS = RK4(scanned=True), diffrax.Heun(), diffrax.ImplicitEuler()
PAIRS = [(name, RK4(substeps=2)) for name in FIELDS] + [*product(("pendulum", "convolution with an input"), SOLVERS)]


def numbers(*shape):
    return jnp.asarray(np.random.default_rng(0).random(shape), jnp.float32)


def difference(found, expected):
    return float(jnp.abs(found - expected).max() / jnp.abs(expected).max())


@pytest.mark.parametrize(("name", "solver"), PAIRS)
def test_they_are_the_derivatives_of_the_trajectory(name, solver):
    field, size, inputs = FIELDS[name]
    x0, u = numbers(size), numbers(3, inputs)
    theta, at = ravel_learned(field)
    of_theta = lambda theta: integrate(at(theta), x0, u, 0.1, solver)  # noqa: E731
    states, columns = eqx.filter_jit(with_sensitivities)(field, x0, u, 0.1, solver)
    expected, slopes = jax.jit(lambda theta: (of_theta(theta), jax.jacfwd(of_theta)(theta)))(theta)
    assert difference(states, expected) < 1e-5
    assert difference(columns, slopes) < 1e-4


@pytest.mark.parametrize("name", sorted(FIELDS))
def test_columns_are_those_of_the_state_and_the_input(name):
    field, size, inputs = FIELDS[name]
    x, u, dx, du = numbers(size), numbers(inputs), numbers(size, 3) - 0.5, numbers(inputs, 3) - 0.5

    @jax.jit
    def both(x, u, dx, du):
        expected = jax.vmap(lambda dx, du: jax.jvp(field, (x, u), (dx, du))[1], -1, -1)(dx, du)
        return as_field(field).linearize(x, u, dx, du), (field(x, u), expected)

    for found, expected in zip(*both(x, u, dx, du), strict=True):
        assert difference(found, expected) < 1e-5
