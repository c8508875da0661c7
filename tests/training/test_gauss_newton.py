"""Gauss–Newton over all parameters of a field, and the derivatives of a trajectory that it needs."""

from itertools import product

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from pendulum import pendulum, swings
from surface import refusal

import hybrid_jax as hj
from experiments.reaction_diffusion.systems import Conversion, gray_scott
from hybrid_jax.dynamics.base import as_field, ravel_learned
from hybrid_jax.integrate import RK4, integrate
from hybrid_jax.networks.grids import GridNetwork
from hybrid_jax.training.gauss_newton import PENALTIES, with_sensitivities
from hybrid_jax.training.loss import REGULARISERS, Minibatch

KEY = jax.random.key(0)
GRID = hj.Grid((4, 5), 0.3, 2)
DIFFUSION = hj.diffusion(GRID, (0.03, 0.01))


def network(norm="none"):
    return hj.residual_network(2, 1, KEY, hidden=4, norm=norm, activation="tanh")


def field():
    return hj.Hybrid(pendulum(), network())


def test_it_goes_far_below_what_adam_reaches_and_a_heavy_penalty_silences_the_network():
    windows = swings(30, steps=5)
    start = hj.with_scaling(field(), windows)
    found = hj.fit_gauss_newton(start, windows, max_steps=20)
    adam = hj.fit(start, windows, windows, KEY, max_epochs=20, min_epochs=20)
    assert found.loss < 0.1 * float(adam.best_mse)
    assert found.steps <= 20
    windows = swings(20, steps=3)
    free = hj.fit_gauss_newton(field(), windows, max_steps=8).field
    held = hj.fit_gauss_newton(field(), windows, penalty="residual_norm", weight=100.0, max_steps=8).field
    norms = [float(jnp.linalg.norm(jax.vmap(one.residual)(windows.x0, windows.u[:, 0]))) for one in (free, held)]
    assert norms[1] < 0.1 * norms[0]


@pytest.mark.parametrize("name", ["residual_norm", "trajectory_correlation"])
def test_rows_are_the_root_of_the_penalty(name):
    windows = swings(3, steps=4)
    model, penalty, own = hj.with_scaling(field(), windows), eqx.filter_jit(PENALTIES[name]), []
    for i in range(3):
        window = jax.tree.map(jnp.asarray, windows[i])
        predicted = hj.rollout(model, window.x0, window.u, window.dt)
        own.append(float(jnp.sum(jnp.square(penalty(model, predicted, window, RK4())))))
    batch = Minibatch(*(jnp.moveaxis(jnp.asarray(a), 0, -1) for a in (windows.x0, windows.u, windows.x)), dt=windows.dt)
    predicted = jnp.moveaxis(hj.rollout_batch(model, windows.x0, windows.u, windows.dt), 0, -1)
    assert np.mean(own) == pytest.approx(float(REGULARISERS[name](model, batch, predicted)), rel=1e-4)


def test_bad_input_ends_in_one_line():
    windows, large = swings(5, steps=2), hj.residual_network(2, 1, KEY, hidden=400)
    refusal(lambda: hj.fit_gauss_newton(field(), windows, penalty="l1"), "penalty must be one of residual_norm")
    refusal(lambda: hj.fit_gauss_newton(field(), windows, weight=-1.0), "weight must be")
    refusal(lambda: hj.fit_gauss_newton(field(), windows, scale=np.ones(3)), "scale must")
    for wrong in (large, lambda x, u: x):
        refusal(lambda wrong=wrong: hj.fit_gauss_newton(wrong, windows), "1 to 1000 parameters expected")


class Falling(hj.AbstractVectorField):
    """Physics whose state shows forces elsewhere, by way of a parameter of its own."""

    log_mass: jax.Array

    def __call__(self, x, u):
        return jnp.stack([x[1], u[0] - jnp.exp(self.log_mass)])

    def apply_residual(self, x, residual):
        return jnp.stack([x[0] * residual[1], residual[1] / jnp.exp(self.log_mass)])


def reaction(kernel, inputs=0, **options):
    return hj.grid_network(GRID, inputs, KEY, kernel=kernel, hidden=3, **options)


def conversion():
    scott = gray_scott([(0.03, 0.06), (0.04, 0.05)], reacts=True)
    rate = hj.residual_network(2, 0, KEY, outputs=1, hidden=3, activation="tanh", norm="none")
    return hj.Hybrid(scott, Conversion(GridNetwork(rate, scott.grid))), scott.grid.size, 2


FIELDS = {  # and the numbers in x and u
    "pendulum": lambda: (hj.Hybrid(pendulum(), network("layer")), 2, 1),
    "batch norm": lambda: (network("batch"), 2, 1),
    "forces elsewhere": lambda: (hj.Hybrid(Falling(jnp.asarray(0.3)), network()), 2, 1),
    "pointwise": lambda: (hj.Hybrid(DIFFUSION, reaction(1)), GRID.size, 0),
    "convolution with an input": lambda: (hj.Hybrid(DIFFUSION, reaction(3, 1)), GRID.size, 1),
    "frozen physics": lambda: (hj.Hybrid(hj.Frozen(DIFFUSION), reaction(3, norm="layer")), GRID.size, 0),
    "conversion": conversion,
}
# Every field with one solver, every other solver with two fields: each pair would be two programs to compile.
SOLVERS = RK4(scanned=True), diffrax.Heun(), diffrax.ImplicitEuler()
PAIRS = [(name, RK4(substeps=2)) for name in FIELDS] + [*product(("pendulum", "convolution with an input"), SOLVERS)]


def numbers(*shape):
    return jnp.asarray(np.random.default_rng(0).random(shape), jnp.float32)


def difference(found, expected):
    return float(jnp.abs(found - expected).max() / jnp.abs(expected).max())


@pytest.mark.parametrize(("name", "solver"), PAIRS)
def test_sensitivities_are_the_derivatives_of_the_trajectory(name, solver):
    field, size, inputs = FIELDS[name]()
    x0, u = numbers(size), numbers(3, inputs)
    theta, at = ravel_learned(field)
    of_theta = lambda theta: integrate(at(theta), x0, u, 0.1, solver)  # noqa: E731
    states, columns = eqx.filter_jit(with_sensitivities)(field, x0, u, 0.1, solver)
    expected, slopes = jax.jit(lambda theta: (of_theta(theta), jax.jacfwd(of_theta)(theta)))(theta)
    assert difference(states, expected) < 1e-5
    assert difference(columns, slopes) < 1e-4


@pytest.mark.parametrize("name", sorted(FIELDS))
def test_columns_are_those_of_the_state_and_the_input(name):
    field, size, inputs = FIELDS[name]()
    x, u, dx, du = numbers(size), numbers(inputs), numbers(size, 3) - 0.5, numbers(inputs, 3) - 0.5

    @jax.jit
    def both(x, u, dx, du):
        expected = jax.vmap(lambda dx, du: jax.jvp(field, (x, u), (dx, du))[1], -1, -1)(dx, du)
        return as_field(field).linearize(x, u, dx, du), (field(x, u), expected)

    for found, expected in zip(*both(x, u, dx, du), strict=True):
        assert difference(found, expected) < 1e-5
