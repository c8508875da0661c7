"""The same mathematics as it reads, to time ours against: one sample at a time, every derivative by autodiff."""

from collections.abc import Callable
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import optax

from benchmarks.subjects import DT
from hybrid_jax.dynamics.base import AbstractVectorField, RunningStats, trainable
from hybrid_jax.dynamics.composition import Hybrid
from hybrid_jax.networks.mlp import ResidualNetwork
from hybrid_jax.networks.normalisation import BatchNorm

SAMPLES = "samples"  # the axis over a minibatch


def rk4(field: Callable, x0, u):
    """The states of one window, by classical RK4 in a scan, without diffrax."""

    def step(x, held):
        k1 = field(x, held)
        k2 = field(x + DT / 2 * k1, held)
        k3 = field(x + DT / 2 * k2, held)
        k4 = field(x + DT * k3, held)
        x = x + DT / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        return x, x

    return jax.lax.scan(step, x0, u)[1]


def moments(hidden):
    """Mean and variance of hidden units over the samples of the minibatch; further axes are averaged before."""
    others = tuple(range(1, hidden.ndim))
    mean = jax.lax.pmean(jnp.mean(hidden, others), SAMPLES)
    deviation = hidden - jnp.expand_dims(mean, others)
    return mean, jax.lax.pmean(jnp.mean(jnp.square(deviation), others), SAMPLES)


def derivative(field: AbstractVectorField, x, u):
    """ẋ of one sample of a minibatch, as in training."""
    if isinstance(field, Hybrid):
        return derivative(field.physics, x, u) + derivative(field.residual, x, u)
    if not (isinstance(field, ResidualNetwork) and isinstance(field.norm, BatchNorm)):
        return field(x, u)
    hidden = field.weight_in @ field.scaling.concatenate(x, u)
    mean, variance = moments(hidden)
    normalised = (hidden - mean) / jnp.sqrt(variance + field.norm.epsilon)
    return field.weight_out @ jax.nn.relu(field.norm.gain * normalised + field.norm.shift) + field.bias_out


def loss_of(field: AbstractVectorField, weight, x0, u, x):
    """L of one sample (paper, Eq. 6 and 7), and its predicted states."""
    predicted = rk4(partial(derivative, field), x0, u)
    error = jnp.mean(jnp.sum(jnp.square(predicted - x), axis=1))
    if not isinstance(field, Hybrid):
        return error, predicted
    physics = rk4(field.physics, x0, u)
    a, b = (states.ravel() / jnp.linalg.norm(states) for states in (physics, predicted))
    return error + weight * 0.5 * jnp.sum(jnp.square(a - b)), predicted


def observed(field: AbstractVectorField, x0, u, predicted):
    """The field with its running statistics moved, written for one sample."""
    if isinstance(field, Hybrid):
        return Hybrid(field.physics, observed(field.residual, x0, u, predicted))
    if not (isinstance(field, ResidualNetwork) and isinstance(field.norm, BatchNorm)):
        return field
    starts = jnp.concatenate([x0[None], predicted[:-1]])
    mean, variance = moments(field.weight_in @ field.scaling.concatenate(starts.T, u.T))
    norm = field.norm
    running = jax.tree.map(
        lambda old, new: old + norm.momentum * (new - old), norm.running, RunningStats(mean, variance)
    )
    return eqx.tree_at(lambda network: network.norm.running, field, running)


def training_step(field: AbstractVectorField, adam, plan, windows):
    """One step of Adam, as `training.gradient_step` makes it."""
    parameters, rest = eqx.partition(field, trainable(field))
    over_samples = partial(jax.vmap, axis_name=SAMPLES)

    def objective(parameters):
        one = partial(loss_of, eqx.combine(parameters, rest), plan.regulariser_weight)
        losses, predicted = over_samples(one)(windows.x0, windows.u, windows.x)
        return jnp.mean(losses), predicted

    (value, predicted), gradient = jax.value_and_grad(objective, has_aux=True)(parameters)
    direction, adam = optax.scale_by_adam().update(gradient, adam)
    moved = jax.tree.map(
        lambda rate, p, d: jax.tree.map(lambda p, d: p - rate * d, p, d), plan.rates, parameters, direction
    )
    field = over_samples(partial(observed, eqx.combine(moved, rest)), out_axes=None)(windows.x0, windows.u, predicted)
    return field, adam, value
