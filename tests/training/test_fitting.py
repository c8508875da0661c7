"""What `fit` refuses in one line, and laws of what makes it independent of units: scaling and the scaled loss."""

from dataclasses import replace
from functools import cache

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from pendulum import pendulum, swings
from surface import refusal
from systems import SYSTEMS, Gain

import hybrid_jax as hj
from hybrid_jax import AbstractVectorField, Frozen, Hybrid, Model, Settings, Stage, fit, fit_in_stages, residual_network
from hybrid_jax.networks.mlp import LinearSkip
from hybrid_jax.networks.normalisation import ChannelScaling, InputScaling
from hybrid_jax.sweep import stack, sweep
from hybrid_jax.training.fitting import make_run_config, start
from hybrid_jax.training.objective import TrajectoryLoss, scaled_loss

TRAIN, VALIDATION, KEY = swings(60), swings(40, seed=1), jax.random.key(0)
NETWORK = residual_network(2, 1, KEY, hidden=4)
FIELD, SHORTER = Hybrid(pendulum(), NETWORK), pendulum(0.8)


class Stopped(AbstractVectorField):
    """A wrapper that hides its field from differentiation."""

    gain: jax.Array
    field: AbstractVectorField

    def __call__(self, x, u):
        return self.gain * jax.lax.stop_gradient(self.field(x, u))


class Stiff(AbstractVectorField):
    length: float

    def __call__(self, x, u):
        return jnp.stack([x[1], u[0] - jnp.sin(x[0]) / self.length])


NARROW = Hybrid(pendulum(), residual_network(2, 1, KEY, outputs=1))
SPOILED = eqx.tree_at(lambda w: w.x, TRAIN, TRAIN.x.at[2, 3, 1].set(jnp.inf))
NOTHING = "{} has nothing to learn, no array .* convert Python floats by jnp.asarray$"
REFUSED = {
    "validation": (pendulum(), {"validation": SPOILED}, r"validation: x\[2, 3, 1\] is not finite"),
    "weight": (pendulum(), {"regulariser_weight": 1.0}, "regulariser_weight is 1.0 but settings.regulariser is None;"),
    "optimiser": (pendulum(), {"optimiser": "adam"}, r"optimiser must be an optax\.GradientTransformation"),
    "line search": (pendulum(), {"optimiser": optax.lbfgs()}, "optimiser must need nothing but gradients and param"),
    "hidden": (Stopped(jnp.ones(()), NETWORK), {}, "field: Stopped contains a BatchNorm whose minibatch statistics"),
    "float": (Stiff(1.0), {}, f"field: {NOTHING.format('Stiff')}"),
    "integer": (Hybrid(Stiff(jnp.array(1)), NETWORK), {}, "field: physics.length is an integer, which is not learned;"),
    "another dt": (pendulum(), {"validation": replace(VALIDATION, dt=0.1)}, "validation: dt must be 0.05, .* got 0.1$"),
    "settings": (pendulum(), {"settings": "rk4"}, "settings must be a Settings, got 'rk4'"),
    "model": (Model(FIELD), {}, "field: must be a function .* got Model; pass its .field$"),
    "inputs": (Hybrid(pendulum(), residual_network(2, 3, KEY)), {}, "train: field: ResidualNetwork does not accept a"),
    "rotors": (hj.rigid_body(hj.IRIS), {}, "train: field: RigidBody does not accept .* 13 and 4 numbers, got 2 and 1$"),
    "one output": (NARROW, {}, r"train: field: ResidualNetwork must return .* \(2,\) for .* returned float32\[1\]$"),
    "no stages": (FIELD, {"stages": []}, ".*stages"),
    "no list": (FIELD, {"stages": Stage({"": 0.1})}, "stages must be a list of Stage, got Stage"),
    "too long": (FIELD, {"stages": [Stage({"": 0.1}, steps=9)]}, ".*steps"),
    "no such part": (FIELD, {"stages": [Stage({"wing": 0.1})]}, ".*'wing'"),
    "stages of none": (Frozen(FIELD), {"stages": [Stage({"": 0.1})]}, "field: Frozen has nothing to learn"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_cannot_be_trained_is_refused_by_name(name):
    field, options, said = REFUSED[name]
    given = {"train": TRAIN, "validation": VALIDATION, "key": KEY, "settings": Settings(20)} | options
    with pytest.raises(ValueError, match=f"^{said}"):
        (fit_in_stages if "stages" in options else fit)(field, **given)


def test_fewer_windows_than_a_minibatch_make_one():
    most, all_of_them = (fit(FIELD, TRAIN, VALIDATION, KEY, max_epochs=2, settings=Settings(n)) for n in (100, 60))
    assert eqx.tree_equal(most.best, all_of_them.best)


@pytest.mark.parametrize("alone", [True, False], ids=["fit", "sweep"])
def test_one_window_is_not_normalised_by_itself(alone):
    def train(field):
        if alone:
            return fit(field, TRAIN, VALIDATION, KEY, settings=Settings(1), max_epochs=1)
        plan = make_run_config(0.03, jnp.arange(60), 60, 0, 1, 1, 0.0)
        return sweep(stack([start(field, KEY)]), stack([plan]), TRAIN, VALIDATION, Settings(1))

    with pytest.raises(ValueError, match=r"^settings.batch_size must be at least 2 if the field contains a BatchNorm"):
        train(FIELD)
    state = train(Hybrid(Hybrid(pendulum(), residual_network(2, 1, KEY, hidden=4, norm="layer")), Frozen(NETWORK)))
    assert np.all((state.epochs if alone else state.epoch) == 1)


car = SYSTEMS["car"]  # cached


@cache
def scaled():
    return hj.with_scaling(car().model, car().train)


def samples(windows):
    before = np.concatenate([windows.x0[:, None], windows.x[:, :-1]], axis=1)
    return before.reshape(-1, before.shape[-1]), np.reshape(windows.u, (-1, windows.u.shape[-1]))


def test_every_input_has_mean_zero_and_deviation_one_and_a_unit_of_the_state_changes_nothing():
    z = jax.vmap(scaled().residual.inputs)(*samples(car().train))
    np.testing.assert_allclose(jnp.mean(z, axis=0), 0, atol=1e-3)
    np.testing.assert_allclose(jnp.std(z, axis=0), 1, rtol=1e-3)  # float32 means of hundreds
    x, u = samples(car().train)
    unit = np.array([1e-3, 1, 1, 1, 1, 1], np.float32)
    windows = hj.Trajectories(car().train.x0 * unit, car().train.u, car().train.x * unit, car().train.dt)
    network = hj.residual_network(6, 2, KEY, hidden=4)
    metres, kilometres = hj.with_scaling(network, car().train), hj.with_scaling(network, windows)
    read = jax.vmap(kilometres.inputs)(x * unit, u)
    np.testing.assert_allclose(jax.vmap(metres.inputs)(x, u), read, rtol=1e-3, atol=1e-3)
    np.testing.assert_allclose(kilometres.scaling.output[0], 1e-3 * metres.scaling.output[0], rtol=1e-3)


def test_networks_inside_other_fields_are_scaled_constant_channels_and_a_scaling_that_was_given_left():
    still = eqx.tree_at(lambda w: w.u, car().train, jnp.zeros_like(car().train.u))
    assert hj.with_scaling(car().model, still).residual.scaling.scale[-2:] == (1.0, 1.0)
    network = hj.residual_network(6, 2, KEY, hidden=4)
    for field in (Gain(jnp.zeros(()), network), LinearSkip(jnp.zeros((6, 8)), network)):
        scaling = hj.with_scaling(hj.Hybrid(car().model.physics, field), car().train).residual.field.scaling
        assert scaling == scaled().residual.scaling
    given = hj.residual_network(6, 2, KEY, scaling=InputScaling(1.0, 2.0))
    for field in (given, scaled(), car().model.physics):
        assert hj.with_scaling(field, car().validation) is field


def test_training_leaves_the_scaling_and_a_file_keeps_it(tmp_path):
    trained = hj.fit(car().model, car().train, car().validation, KEY, max_epochs=2).best
    kept = trained.residual.scaling
    assert replace(kept, learned_from=None) == scaled().residual.scaling != ChannelScaling()
    hj.save(tmp_path / "car.npz", trained)
    found = hj.load(tmp_path / "car.npz").field
    assert eqx.tree_equal(found, trained)
    np.testing.assert_array_equal(found.residual.scaling.learned_from.x[-1], car().train.x[-1])


def loss(objective, windows, field=SHORTER):
    return objective.loss(field, objective.batch(windows, hj.Settings()), hj.Settings(), 0.0)[0]


def test_a_scale_counts_errors_in_its_units_and_those_of_a_field_are_its_changes_over_a_window():
    """States without a scale of their own do not count; windows are predicted whole, and in chunks."""
    many = jax.tree.map(lambda leaf: np.tile(leaf, (26, *(1,) * (leaf.ndim - 1))), VALIDATION)
    for scale in ((1.0, 1.0), (0.5, 2.0), (0.5, np.inf)):
        objective, unit = TrajectoryLoss(scale), np.array(scale)
        errors = hj.rollout_batch(SHORTER, VALIDATION.x0, VALIDATION.u, VALIDATION.dt) - VALIDATION.x
        expected = np.mean(np.sum(np.square(errors / unit), axis=-1))
        np.testing.assert_allclose(loss(objective, VALIDATION), expected, rtol=1e-5)
        for data in (VALIDATION, many):
            np.testing.assert_allclose(objective.validate(SHORTER, data, hj.Settings()), expected, rtol=1e-5)
    last = (TRAIN.x - TRAIN.x0[:, None])[:, -1]
    counted = last / np.array(scaled_loss(SHORTER, TRAIN).scale)
    np.testing.assert_allclose(np.square(counted).sum(axis=-1).mean(), 2.0, rtol=1e-5)  # two quantities
    half = jax.tree.map(lambda leaf: leaf / 2, eqx.tree_at(lambda w: w.u, TRAIN, TRAIN.x))
    np.testing.assert_allclose(last / 2 / np.array(scaled_loss(SHORTER, half).scale), counted, rtol=1e-5)
    for scale in ((1.0, 0.0), (np.nan,), [1.0]):
        refusal(lambda scale=scale: TrajectoryLoss(scale), "scale must")
    refusal(lambda: TrajectoryLoss((1.0,) * 3).prepare(TRAIN, "train"), "train: states of 3")
