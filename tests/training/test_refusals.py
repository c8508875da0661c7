"""What training refuses, in one line that says what is wrong."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from pendulum import pendulum, swings

import hybrid_jax as hj
from hybrid_jax import AbstractVectorField, Frozen, Hybrid, Model, Settings, Stage, fit, fit_in_stages, residual_network
from hybrid_jax.sweep import stack, sweep
from hybrid_jax.training.fitting import make_run_config, start

TRAIN, VALIDATION, KEY = swings(60), swings(40, seed=1), jax.random.key(0)
NETWORK = residual_network(2, 1, KEY, hidden=4)
FIELD = Hybrid(pendulum(), NETWORK)


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
