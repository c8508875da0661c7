"""Whatever Equinox module a user writes is saved and comes back the same, and a file never runs code."""

import functools
import re
import subprocess
import sys
import warnings
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from pendulum import pendulum
from surface import refusal
from systems import Dense

import hybrid_jax as hj
from hybrid_jax.dynamics.rigid_body import Kinematics
from hybrid_jax.io import structure
from hybrid_jax.io.files import named_leaves, save_archive
from hybrid_jax.io.models import FORMAT
from hybrid_jax.networks.standardise import with_motion, with_scaling


class Convolution(hj.AbstractVectorField):
    layers: list

    def __call__(self, x, u):
        return x


class Scaled(hj.AbstractVectorField):
    inner: hj.AbstractVectorField
    scale: tuple = eqx.field(static=True)

    def __call__(self, x, u):
        return jnp.asarray(self.scale) * self.inner(x, u)


@hj.portable
def leaky(z):
    return jnp.where(z > 0, z, 0.3 * z)


@hj.portable
@dataclass(frozen=True)
class Options:
    gain: float = 0.5
    steps: tuple = (1, 2)


class Nested(hj.AbstractVectorField):
    blocks: dict
    limits: tuple
    noise: jax.Array
    dtype: object = eqx.field(static=True)
    options: Options = eqx.field(static=True)

    def __init__(self, key):
        first, second, self.noise = jax.random.split(key, 3)
        linear = [eqx.nn.Linear(3, 3, key=key) for key in (first, second)]
        self.blocks = {"layers": [(linear[0], eqx.nn.LayerNorm(3), leaky), (linear[1], None, jax.nn.silu)]}
        self.blocks |= {"shift": {0: jnp.full(2, 0.1, jnp.bfloat16)}}
        self.limits, self.dtype, self.options = (-float("inf"), 5.0), jnp.float32, Options(0.7)

    def __call__(self, x, u):
        return x


KEY = jax.random.PRNGKey(0)
MAKERS = {
    "perceptron": lambda: Dense(eqx.nn.MLP(3, 2, 8, 2, activation=jax.nn.gelu, key=KEY)),
    "convolution": lambda: Convolution([eqx.nn.Conv1d(1, 4, 3, key=KEY), jnp.tanh, eqx.nn.Conv1d(4, 1, 3, key=KEY)]),
    "wrapper": lambda: Scaled(hj.residual_network(2, 1, KEY, hidden=4), (1.0, 2.0)),
    "pendulum": lambda: hj.Hybrid(pendulum(0.7), hj.residual_network(2, 1, KEY, hidden=4)),
    "nested": lambda: Nested(jax.random.key(0)),  # which keeps its key
    "no physics": lambda: hj.Hybrid(Kinematics(), hj.residual_network(13, 4, KEY, hidden=4)),
    "side by side": lambda: eqx.filter_vmap(lambda key: hj.residual_network(2, 1, key))(jax.random.split(KEY)),
}


@functools.cache
def made(name):
    """A model with random weights; the same at every call."""
    return MAKERS[name]()


@pytest.mark.parametrize("name", MAKERS)
def test_a_loaded_model_is_the_saved_one(name, tmp_path):
    path, field = tmp_path / "model.npz", made(name)
    assert hj.check_savable(field) is None
    with warnings.catch_warnings(action="error"):
        hj.save(path, field)
    for loaded in (hj.load(path).field, hj.load(path, like=MAKERS[name]()).field):
        assert eqx.tree_equal(named_leaves(loaded), named_leaves(field))
        assert structure.Structure(loaded).tree == structure.Structure(field).tree


def module_with(monkeypatch, name, sign):
    """An imported module of this name with a class Linear: ẋ = sign a x."""
    module = ModuleType(name)
    code = "import hybrid_jax as hj\nclass Linear(hj.AbstractVectorField):\n    a: object\n"
    exec(f"{code}    def __call__(self, x, u): return {sign} * self.a * x", vars(module))
    monkeypatch.setitem(sys.modules, name, module)
    return module


def test_classes_of_one_name_are_told_apart_by_module_which_is_named_if_it_is_not_imported(tmp_path, monkeypatch):
    one, other = module_with(monkeypatch, "one", 1), module_with(monkeypatch, "other", -1)
    for module in (one, other):
        hj.save(tmp_path / f"{module.__name__}.npz", module.Linear(jnp.ones(())))
    assert type(hj.load(tmp_path / "one.npz").field) is one.Linear
    assert type(hj.load(tmp_path / "other.npz").field) is other.Linear
    monkeypatch.delitem(sys.modules, "one")
    refusal(lambda: hj.load(tmp_path / "one.npz"), "one:Linear ", "import one first, or pass like=")
    assert hj.load(tmp_path / "one.npz", like=one.Linear(jnp.zeros(()))).field.a == 1


def test_a_portable_name_outlives_its_module_and_is_unique(tmp_path, monkeypatch):
    monkeypatch.setattr(structure, "_PORTABLE", {})
    old, new = module_with(monkeypatch, "old", 1), module_with(monkeypatch, "new", 1)
    hj.save(tmp_path / "model.npz", hj.portable(old.Linear, name="linear")(jnp.ones(())))
    refusal(lambda: hj.portable(name="linear")(new.Linear), "'linear' is taken by old:Linear")
    monkeypatch.setattr(structure, "_PORTABLE", {})
    hj.portable(name="linear")(new.Linear)
    assert type(hj.load(tmp_path / "model.npz").field) is new.Linear


def local_field(gain=2.0, size=3, dtype=np.float32):
    class Local(hj.AbstractVectorField):
        net: eqx.Module
        gain: jax.Array

        def __call__(self, x, u):
            return self.gain * self.net(x)

    return Local(eqx.nn.Linear(size, size, key=KEY), jnp.asarray(gain, dtype))


def with_activation(function):
    return eqx.tree_at(lambda field: field.network.activation, made("perceptron"), function)


ACTIVATION = "field/network/activation"
# Name → model that a file cannot rebuild, the same with other weights, and the part that is the reason.
SKELETONS = {
    "local class": lambda: (local_field(), local_field(5.0), r"field: .*<locals>\.Local"),
    "lambda": lambda: (with_activation(lambda z: z), with_activation(lambda z: z), ACTIVATION),
    "partial": lambda: (with_activation(functools.partial(jax.nn.gelu)), made("perceptron"), ACTIVATION),
    "own function": lambda: (with_activation(local_field), made("perceptron"), f"{ACTIVATION}.*local_field"),
}


@pytest.mark.parametrize("name", SKELETONS)
def test_what_a_file_cannot_rebuild_is_filled_into_a_skeleton(name, tmp_path):
    path, (field, like, reason) = tmp_path / "model.npz", SKELETONS[name]()
    like = jax.tree.map(lambda leaf: leaf + 1 if eqx.is_inexact_array(leaf) else leaf, like)
    assert re.fullmatch(rf"{reason}.*", hj.check_savable(field))
    with pytest.warns(UserWarning, match=rf"like=.*{reason}"):
        hj.save(path, field)
    with pytest.raises(ValueError, match=rf"model\.npz: .*{reason if name != 'local class' else ''}.*pass like="):
        hj.load(path)
    loaded = hj.load(path, like=like).field
    assert eqx.tree_equal(named_leaves(loaded), named_leaves(field))
    assert type(loaded) is type(like)


@pytest.mark.filterwarnings("ignore:.*like=")
def test_a_fitted_model_fills_a_new_one_and_a_skeleton_that_does_not_fit_is_refused_by_its_first_leaf(tmp_path):
    def new(key):
        network = hj.residual_network(3, 1, key, hidden=4, norm="none", activation="tanh")
        return hj.Hybrid(local_field(), network)

    windows = hj.Trajectories(jnp.ones((5, 3)), jnp.ones((5, 2, 1)), jnp.ones((5, 2, 3)), 0.1)
    fitted = with_motion(with_scaling(new(KEY), windows), windows)
    hj.save(tmp_path / "model.npz", fitted)
    loaded = hj.load(tmp_path / "model.npz", like=new(jax.random.key(1))).field
    assert eqx.tree_equal(named_leaves(loaded), named_leaves(fitted))
    assert loaded.residual.scaling.offset == fitted.residual.scaling.offset != new(KEY).residual.scaling.offset
    hj.save(tmp_path / "model.npz", local_field())
    for like, said in (
        (local_field(size=4), r"'field/net/bias' is float32\[3\], expected float32\[4\]$"),
        (local_field(dtype=np.int32), r"'field/gain' is float32\[\], expected int32\[\]$"),
        (pendulum(), r"'field/gain' is float32\[\], expected none$"),
    ):
        with pytest.raises(ValueError, match=said):
            hj.load(tmp_path / "model.npz", like=like)
    hj.save(tmp_path / "model.npz", made("wrapper"))
    other = Scaled(made("wrapper").inner, (1.0, 3.0))
    refusal(lambda: hj.load(tmp_path / "model.npz", like=other), "field/scale/1 is 2.0, but 3.0 in `like`$")


def test_another_program_cannot_import_a_class_of_the_script(tmp_path):
    (tmp_path / "script.py").write_text(
        "import jax.numpy as jnp, hybrid_jax as hj\n"
        "class Own(hj.AbstractVectorField):\n    a: object\n    def __call__(self, x, u): return self.a * x\n"
        "hj.save('own.npz', Own(jnp.ones(())))\n"
    )
    run = [sys.executable, "script.py"]
    done = subprocess.run(run, cwd=tmp_path, capture_output=True, text=True, check=True)
    assert "class Own is of the script that runs; define it in a module" in done.stderr


def test_what_cannot_be_saved_is_refused_with_its_path(tmp_path):
    reason = r"field/layers/1 is of type .*TextIOWrapper, which cannot be saved"
    with Path(__file__).open() as file:
        field = eqx.tree_at(lambda field: field.layers[1], made("convolution"), file)
        assert re.match(reason, hj.check_savable(field))
        with pytest.raises(ValueError, match=reason):
            hj.save(tmp_path / "model.npz", field)
    assert hj.check_savable(len).startswith("field must be an Equinox module")
    assert not list(tmp_path.iterdir())


LINEAR = "equinox.nn._linear:Linear"
HOSTILE = {
    "class that is a function": {"class": "os:system", "fields": {"command": "touch sprung"}},
    "class of another kind": {"class": "subprocess:Popen", "fields": {"args": "touch sprung"}},
    "module as class": {"class": "os", "fields": {}}, "function of an imported module": {"named": "os.system"},
    "builtin": {"named": "builtins.eval"}, "function that reads files": {"named": "jax.numpy.load"},
    "module that is not imported": {"class": "antigravity:Module", "fields": {}},
    "class by another name": {"class": "hybrid_jax:Hybrid", "fields": {"physics": 1, "residual": 1}},
    "method": {"class": f"{LINEAR}.__call__", "fields": {}},
    "attribute of a method": {"class": f"{LINEAR}.__init__.__globals__", "fields": {}},
    "abstract class": {"class": "hybrid_jax.dynamics.base:AbstractVectorField", "fields": {}},
    "fields of another class": {"class": LINEAR, "fields": {"__class__": "os", "__dict__": 1}},
    "unknown entry": {"run": "touch sprung"},
}  # fmt: skip


@pytest.mark.parametrize("name", HOSTILE)
def test_a_hostile_structure_is_refused(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    inside = {"class": "hybrid_jax.dynamics.base:Hybrid", "fields": {"physics": HOSTILE[name], "residual": None}}
    for tree in (HOSTILE[name], inside):
        save_archive("hostile.npz", FORMAT, {"field": tree, "about": {}}, {})
        with pytest.raises(ValueError, match=r"^hostile\.npz: .*$"):
            hj.load("hostile.npz")
    assert [path.name for path in tmp_path.iterdir()] == ["hostile.npz"]
    assert "antigravity" not in sys.modules


class Alarm(eqx.Module):
    """It would tell if any code of it ran."""

    command: str

    def __init__(self, command):
        raise AssertionError(command)

    __check_init__ = __init__


def test_no_code_of_a_users_class_runs(tmp_path):
    tree = {"class": f"{__name__}:Alarm", "fields": {"command": "touch sprung"}}
    save_archive(tmp_path / "model.npz", FORMAT, {"field": tree, "about": {}}, {})
    assert hj.load(tmp_path / "model.npz").field.command == "touch sprung"
