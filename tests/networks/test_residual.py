"""Laws of the network f_d and its normalisations."""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from surface import refusal
from systems import infer_batch, train_batch

from hybrid_jax import Hybrid, load, save
from hybrid_jax.dynamics import base
from hybrid_jax.networks.mlp import FusedNetwork, InputScaling, LinearSkip, SmoothRelu, residual_network, smoothed
from hybrid_jax.networks.normalisation import BatchNorm, Bias, ChannelScaling, LayerNorm

STATES, INPUTS, HIDDEN, COLUMNS = 5, 2, 7, 11


def network(seed=0, hidden=HIDDEN, activation="relu"):
    """A network whose gains, shifts and running statistics are not those of a fresh one."""
    keys = jax.random.split(jax.random.key(seed), 5)
    options = {"hidden": hidden, "scaling": InputScaling(2.0, 3.0), "activation": activation}
    fresh = residual_network(STATES, INPUTS, keys[0], **options)
    gain, shift, mean = (jax.random.normal(key, (hidden,)) for key in keys[1:4])
    running = base.RunningStats(mean, jax.random.uniform(keys[4], (hidden,), minval=0.5, maxval=2.0))
    return eqx.tree_at(lambda field: field.norm, fresh, BatchNorm(gain, shift, running))


def batch(seed=0, columns=COLUMNS):
    rng = np.random.default_rng(seed)
    return jnp.asarray(3 + 2 * rng.normal(size=(STATES, columns))), jnp.asarray(rng.normal(size=(INPUTS, columns)))


def plain(field, x, u, activation):
    """The training formula as the papers write it, for autodiff: γ (h − mean) / √(variance + ε) + β."""
    hidden = field.weight_in @ jnp.concatenate([x, (u - field.scaling.offset) / field.scaling.scale])
    mean, variance = hidden.mean(1, keepdims=True), hidden.var(1, keepdims=True)
    normal = (hidden - mean) / jnp.sqrt(variance + field.norm.epsilon)
    active = activation(field.norm.gain[:, None] * normal + field.norm.shift[:, None])
    return field.weight_out @ active + field.bias_out[:, None]


# Written as in the papers, not as the library has them.
PLAIN = {"relu": lambda h: jnp.maximum(h, 0), "tanh": jnp.tanh}
PLAIN |= {"softplus": lambda h: jnp.log(1 + jnp.exp(h)), "silu": lambda h: h / (1 + jnp.exp(-h))}


@pytest.mark.parametrize("activation", PLAIN)
def test_the_derivative_written_by_hand_is_that_of_the_plain_formula(activation):
    with jax.enable_x64(True):
        field, (x, u) = network(activation=activation), batch()
        weights = jax.random.normal(jax.random.key(9), (STATES, COLUMNS))

        def gradients(formula):
            parameters, rest = eqx.partition((field, x, u), eqx.is_inexact_array)
            return jax.jit(jax.grad(lambda p: jnp.sum(weights * formula(*eqx.combine(p, rest)))))(parameters)

        formula = partial(plain, activation=PLAIN[activation])
        np.testing.assert_allclose(field.train_batch(x, u), formula(field, x, u), rtol=0, atol=1e-12)
        found, expected = (jax.tree.leaves(gradients(one)) for one in (train_batch, formula))
        assert len(found) == len(expected) == 9  # four weights, gain … running statistics (zero), x, u
        for one, other in zip(found, expected, strict=True):
            # Round-off of float64 on gradients of up to about 100.
            np.testing.assert_allclose(one, other, rtol=0, atol=1e-10)
        assert sum(float(jnp.abs(leaf).max()) > 1e-3 for leaf in expected) == 7


@pytest.mark.parametrize("activation", PLAIN)
def test_what_few_samples_use_is_the_same_network_with_the_same_slopes_and_so_is_its_file(activation, tmp_path):
    with jax.enable_x64(True):
        field, (x, u) = network(activation=activation), (part[:, 0] for part in batch())
        fused = field.fuse_for_inference()
        assert isinstance(fused, FusedNetwork)
        directions = jnp.eye(STATES + INPUTS)
        value, slopes = fused.linearize(x, u, directions[:STATES], directions[STATES:])
        np.testing.assert_allclose(value, field(x, u), rtol=0, atol=1e-12)
        np.testing.assert_allclose(slopes, jnp.hstack(jax.jacfwd(field, (0, 1))(x, u)), rtol=0, atol=1e-12)
        save(tmp_path / "field.npz", fused)
        assert eqx.tree_equal(load(tmp_path / "field.npz").field, fused)


@pytest.mark.parametrize("beta", [3.0, 30.0])
def test_a_smoothed_network_is_as_near_as_beta_says_and_only_relu_is_smoothed(beta, tmp_path):
    field, (x, u) = network(), batch()
    smooth = smoothed(Hybrid(field, network(activation="tanh")), beta)
    off = smooth.physics(x, u) - field(x, u)
    # Each hidden unit is between 0 and 1/(2β) above ReLU.
    assert (jnp.abs(off) <= jnp.abs(field.weight_out).sum(axis=1)[:, None] / (2 * beta) + 1e-5).all()
    assert jnp.abs(off).max() > 0.01 / beta
    assert eqx.tree_equal(smooth.residual, network(activation="tanh"))
    assert smoothed(eqx.nn.MLP(2, 2, 3, 1, key=jax.random.key(0)), beta).activation == SmoothRelu(beta)
    save(tmp_path / "smooth.npz", smooth)
    assert eqx.tree_equal(load(tmp_path / "smooth.npz").field, smooth)
    refusal(lambda: smoothed(field, float("nan")), "^beta must be")
    refusal(lambda: network(activation="step"), "^activation must be one of relu, softplus, tanh, silu, got 'step'$")


def test_running_statistics_approach_the_batch_by_a_tenth_each_time_and_a_still_unit_stays_finite():
    with jax.enable_x64(True):
        field, (x, u) = network(), batch()
        hidden = field.weight_in @ field.inputs(x, u)
        target = base.RunningStats(hidden.mean(1), hidden.var(1))
        before, observed = field.norm.running, field
        for _ in range(20):
            observed = observed.update_running_stats(x, u)
        for name in ("mean", "variance"):
            start, end, goal = (getattr(each, name) for each in (before, observed.norm.running, target))
            np.testing.assert_allclose(end - goal, 0.9**20 * (start - goal), rtol=0, atol=1e-12)
        untouched = eqx.tree_at(lambda field: field.norm.running, observed, before)
        assert eqx.tree_equal(untouched, field)
    field = network()
    x, u = jnp.ones((STATES, COLUMNS)), jnp.ones((INPUTS, COLUMNS))
    value, slope = jax.jit(jax.value_and_grad(lambda x: jnp.sum(field.train_batch(x, u))))(x)
    assert jnp.isfinite(value)
    assert jnp.isfinite(slope).all()


def test_a_linear_path_adds_its_map_in_training_and_in_deployment():
    with jax.enable_x64(True):
        field, (x, u) = network(), batch()
        weight = jax.random.normal(jax.random.key(3), (STATES, STATES + INPUTS))
        path = LinearSkip(weight, field)
        line = weight @ jnp.concatenate([x, (u - 2) / 3])
        for evaluate in (train_batch, infer_batch):
            np.testing.assert_allclose(evaluate(path, x, u), evaluate(field, x, u) + line, rtol=0, atol=1e-12)
        assert eqx.tree_equal(path.update_running_stats(x, u), LinearSkip(weight, field.update_running_stats(x, u)))
        assert sum(jax.tree.leaves(base.trainable(path))) == 1 + sum(jax.tree.leaves(base.trainable(field)))


def test_the_paper_s_network_has_the_paper_s_size_and_all_but_running_statistics_is_trainable():
    marks = base.trainable(Hybrid(network(), network()))
    for part in (marks.physics, marks.residual):
        assert jax.tree.leaves(part.norm.running) == [False]
        assert jax.tree.leaves(eqx.tree_at(lambda part: part.norm.running, part, None)) == [True] * 5
    field = residual_network(13, 4, jax.random.key(0))
    learned = eqx.filter(field, base.trainable(field))
    # 17 × 64 (its bias would be removed by batch norm), γ and β of 64, 64 × 13 + 13.
    assert sum(leaf.size for leaf in jax.tree.leaves(learned)) == 17 * 64 + 2 * 64 + 64 * 13 + 13
    for weight, fan_in in ((field.weight_in, 17), (field.weight_out, 64), (field.bias_out, 64)):
        assert 0.85 / fan_in**0.5 < jnp.abs(weight).max() <= 1 / fan_in**0.5  # 13 draws or more, of a fixed seed


def plain_one(field, x, u):
    """One sample as Ba et al. (2016), Eq. 3 and 4, write it, or without normalisation."""
    hidden = field.weight_in @ jnp.concatenate([x, (u - field.scaling.offset) / field.scaling.scale])
    if isinstance(field.norm, LayerNorm):
        mean = jnp.sum(hidden) / HIDDEN
        deviation = jnp.sqrt(jnp.sum((hidden - mean) ** 2) / HIDDEN + field.norm.epsilon)
        hidden = field.norm.gain * (hidden - mean) / deviation
    return field.weight_out @ jnp.maximum(hidden + field.norm.shift, 0) + field.bias_out


@pytest.mark.parametrize("norm", ["layer", "none"])
def test_without_a_batch_s_statistics_training_is_deployment_and_both_the_plain_formula(norm):
    with jax.enable_x64(True):
        field, (x, u) = network(), batch()
        kind = {"layer": LayerNorm(field.norm.gain, field.norm.shift), "none": Bias(field.norm.shift)}[norm]
        field = eqx.tree_at(lambda field: field.norm, field, kind)
        expected = jnp.stack([plain_one(field, x[:, i], u[:, i]) for i in range(COLUMNS)], axis=1)
        np.testing.assert_allclose(jax.vmap(field, -1, -1)(x, u), expected, rtol=0, atol=1e-12)
        np.testing.assert_allclose(field.train_batch(x, u), expected, rtol=0, atol=1e-12)
        # A sample's result does not depend on its neighbours, and nothing is remembered of them.
        np.testing.assert_allclose(field.train_batch(x[:, :3], u[:, :3]), expected[:, :3], rtol=0, atol=1e-12)
        assert eqx.tree_equal(field.update_running_stats(x, u), field)


@pytest.mark.parametrize("shape", [(), (7,)], ids=["sample", "batch"])
@pytest.mark.parametrize("sizes", [(1, 1), (3, 2)], ids=["few inputs", "more"])
@pytest.mark.parametrize("norm", ["batch", "layer", "none"])
@pytest.mark.parametrize("linear", [False, True])
def test_a_network_is_deployed_as_the_same_map(linear, norm, sizes, shape):
    rng = np.random.default_rng(0)
    scales = tuple(rng.uniform(0.5, 2, sum(sizes)).tolist())
    scaling = ChannelScaling(scales, scales, (0.1, 1.0, 2.0))
    network = residual_network(*sizes, jax.random.key(0), hidden=9, norm=norm, outputs=3, scaling=scaling)
    field = LinearSkip(jnp.asarray(rng.normal(size=(3, sum(sizes)))), network) if linear else network
    field = jax.tree.map(lambda leaf: leaf + rng.uniform(0.1, 1.0, leaf.shape), field)
    x, u = (jnp.asarray(rng.normal(size=(size, *shape))) for size in sizes)
    fused = field.fuse_for_inference()
    np.testing.assert_allclose(fused(x, u), field(x, u), rtol=1e-5, atol=1e-5)
    assert isinstance(fused, FusedNetwork) == (norm != "layer")


@pytest.mark.parametrize("shape", [(), (7,)], ids=["sample", "batch"])
def test_a_network_of_two_inputs_is_one_of_more_that_are_zero(shape):
    few = residual_network(1, 1, jax.random.key(0), hidden=9, norm="none", outputs=3)
    more = eqx.tree_at(lambda network: network.weight_in, few, jnp.pad(few.weight_in, ((0, 0), (1, 0))))
    x, u = np.random.default_rng(0).normal(size=(2, 1, *shape))
    np.testing.assert_allclose(few(x, u), more(np.concatenate([np.ones_like(x), x]), u), rtol=1e-5, atol=1e-6)
