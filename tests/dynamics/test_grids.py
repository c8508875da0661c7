"""Fields on periodic grids: the Laplacian, networks on them, and what they refuse."""

from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from surface import refusal

import hybrid_jax as hj
from hybrid_jax.dynamics.base import as_field
from hybrid_jax.export import casadi_function
from hybrid_jax.training.objective import scaled_loss

KEY = jax.random.key(0)
GRID = hj.Grid((6, 8), 0.25, 2)


@pytest.mark.parametrize("shape", [(16,), (12, 16), (8, 8, 10)])
def test_the_laplacian_of_a_wave_is_its_discrete_eigenvalue(shape):
    grid = hj.Grid(shape, 0.5, 2)
    wave = np.cos(2 * np.pi * np.arange(shape[-1]) / shape[-1])
    fields = np.broadcast_to(wave, (2, *shape)) * np.reshape([0, 1], (2, *(1,) * len(shape)))
    eigenvalue = -4 / 0.5**2 * np.sin(np.pi / shape[-1]) ** 2
    np.testing.assert_allclose(grid.laplacian(jnp.asarray(fields)), eigenvalue * fields, atol=1e-5)


@pytest.mark.parametrize("kernel", [1, 3, 5])
@pytest.mark.parametrize("input_size", [0, 1])
def test_a_network_on_a_grid_moves_with_the_state(kernel, input_size):
    """A shifted state has the shifted derivative, for one sample and in a minibatch; only kernels above 1 see far."""
    network = hj.grid_network(GRID, input_size, KEY, kernel=kernel, hidden=4)
    x, u = jax.random.normal(KEY, (GRID.size, 3)), jnp.ones((2, 3))

    def shifted(states):
        return jnp.roll(GRID.fields(states), (2, -3), (1, 2)).reshape(states.shape)

    u = u[:input_size] if input_size else u  # one that reads none accepts any

    @jax.jit
    def evaluated(x, u):
        slopes = as_field(network).train_batch(x, u), as_field(network).train_batch(shifted(x), u)
        return slopes, network(x[:, 1], u[:, 1]), jax.jacobian(network)(x[:, 0], u[:, 0])

    (slope, of_shifted), alone, effect = evaluated(x, u)
    np.testing.assert_allclose(of_shifted, shifted(slope), atol=1e-5)
    np.testing.assert_allclose(alone, slope[:, 1], atol=1e-5)
    effect = effect[: GRID.points, : GRID.points]
    assert int((jnp.abs(effect[0]) > 0).sum()) == kernel**2


def test_a_kernel_of_three_is_a_convolution():
    network = hj.grid_network(GRID, 0, KEY, kernel=3, hidden=5)
    x = jax.random.normal(KEY, (GRID.size,))
    inner = network.network
    kernels = inner.weight_in.reshape(5, 3, 3, 2)
    padded = jnp.pad(GRID.fields(x), ((0, 0), (1, 1), (1, 1)), mode="wrap")
    hidden = jax.lax.conv_general_dilated(padded[None], kernels.transpose(0, 3, 1, 2), (1, 1), "VALID")[0]
    active = jnp.tanh(hidden + inner.norm.shift[:, None, None])
    expected = jnp.tensordot(inner.weight_out, active, 1) + inner.bias_out[:, None, None]
    np.testing.assert_allclose(network(x, jnp.zeros(0)), expected.ravel(), atol=1e-5)
    assert network.neighbour_weights().shape == (5, 16)
    centre = inner.weight_in[:, 8:10]
    others = jnp.sum(inner.weight_in**2) - jnp.sum(centre**2)
    np.testing.assert_allclose(jnp.sum(network.neighbour_weights() ** 2), others, rtol=1e-5)


@cache
def decays(count=6, steps=8, dt=0.1, extra=1.0):
    """Windows of diffusion and a linear decay, which the model below does not know."""
    truth = lambda x, u: hj.diffusion(GRID, (0.02, 0.01))(x, u) - extra * x  # noqa: E731
    x0 = np.random.default_rng(0).normal(size=(count, GRID.size)).astype(np.float32)
    u = np.zeros((count, steps, 0), np.float32)
    return hj.Trajectories(x0, u, np.asarray(jax.jit(partial(hj.rollout_batch, truth, dt=dt))(x0, u)), dt)


@cache
def hybrid(kernel=1):
    return hj.Hybrid(hj.diffusion(GRID, (0.03, 0.006)), hj.grid_network(GRID, 0, KEY, kernel=kernel, hidden=3))


def test_scaling_is_by_component_batch_norm_runs_over_points_and_fields_need_no_input():
    scaling = hj.with_scaling(hybrid(), decays()).residual.network.scaling
    assert [len(part) for part in (scaling.offset, scaling.scale, scaling.output)] == [2, 2, 2]
    scale = scaled_loss(hybrid(), decays()).scale
    assert (len(scale), len(set(scale))) == (GRID.size, 2)
    assert hj.dynamics.disturbance.disturbance_of(hj.with_disturbance(hybrid())).value.shape == (2,)
    field = hj.Hybrid(hj.diffusion(GRID, (0.02, 0.01)), hj.grid_network(GRID, 0, KEY, norm="batch", hidden=3))
    result = hj.fit(field, decays(), decays(), KEY, max_epochs=2)
    assert float(jnp.abs(result.field.residual.network.norm.running.mean).max()) > 0


LARGE = hj.diffusion(hj.Grid((32, 32), 1.0, 2), (0.1, 0.1))
EDGE = np.tile(np.linspace(0, 5, 8, dtype=np.float32), 12)
RAMP = hj.Trajectories(np.tile(EDGE, (6, 1)), np.zeros((6, 8, 0), np.float32), np.tile(EDGE, (6, 8, 1)), 0.1)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: casadi_function(LARGE, state_size=2048, input_size=0), "state_size must be at most 512, got 2048"),
        (lambda: hj.check_grid(GRID, RAMP), "not periodic along axis 1"),
        (lambda: hj.Grid((2, 8)), "shape: each side must be an integer of at least 3"),
        (lambda: hj.diffusion(GRID, (0.1,)), "2 expected, one for each component, got 1"),
        (lambda: hj.grid_network(GRID, 0, KEY, kernel=2), "kernel must be odd and at most 6"),
        (lambda: hj.check_grid(hj.Grid((6, 6), 1.0, 2), decays()), "states of 72 numbers expected"),
        (lambda: hj.check_grid(GRID, decays(), diffusivity=2.0), "unstable, RK4 needs at most 0.0109 s … substeps=10"),
        (lambda: hj.rollout(hybrid(), np.ones(50), np.zeros((1, 0)), 0.1), "needs states of 96 numbers, got 50"),
    ],
)  # fmt: skip
def test_bad_input_ends_in_one_line(call, message):
    refusal(call, *message.split(" … "))


def test_the_largest_step_is_where_rk4_becomes_unstable():
    checkers = jnp.asarray(np.indices(GRID.shape).sum(axis=0) % 2 * 2.0 - 1)
    x0 = jnp.tile(checkers.ravel(), 2)
    bound = GRID.largest_step(0.01)
    field = hj.diffusion(GRID, (0.01, 0.01))
    for share, grows in ((0.98, False), (1.02, True)):
        end = hj.rollout(field, x0, jnp.zeros((60, 0)), bound * share)[-1]
        assert bool(jnp.abs(end).max() > 1) is grows
    steady = hj.rollout(field, x0, jnp.zeros((60, 0)), bound * 1.5, hj.RK4(substeps=2))[-1]
    assert float(jnp.abs(steady).max()) < 1
