"""Programs that are kept on disk are found again without tracing, and only where nothing differs."""

import os
import time
from pathlib import Path
from uuid import uuid4

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from smoke import script

from hybrid_jax import programs, runtime
from hybrid_jax.programs import kept_jit

TRACED, NUMBERS = [], {"unit": 1.0, "of": "x"}


def scaled(factor: float, x):
    """What the array becomes, and values that are not traced."""
    TRACED.append(factor)
    return {"x": factor * NUMBERS["unit"] * x, "factor": factor, "of": NUMBERS["of"]}


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Where programs are kept; this module counts as a package whose source is known."""
    monkeypatch.setattr(runtime, "_kept", [tmp_path])
    salt = uuid4().hex  # JAX's own cache must not have the program
    monkeypatch.setattr(programs, "_environment", lambda: salt)
    monkeypatch.setattr(programs, "KNOWN", programs.KNOWN | {__name__})
    TRACED.clear()
    return tmp_path


def kept(folder):
    return sorted(folder.glob(f"*{runtime.EXECUTABLE}"))


def forget(path):
    """Delete a program from JAX's own cache."""
    for entry in Path(os.environ.get(runtime.PROGRAMS) or path.parent).glob(f"jit_{path.name.partition('-')[0]}*"):
        entry.unlink()


def called(*arguments):
    """The result in what might be a new process, and whether it was traced there."""
    before = len(TRACED)
    found = kept_jit(scaled)(*arguments)
    return found, len(TRACED) > before


def test_a_kept_program_gives_the_same_result_without_tracing(folder):
    x = np.arange(3.0, dtype=np.float32)
    first, traced = called(2.0, x)
    again, traced_again = called(2.0, x)
    assert traced
    assert not traced_again
    assert again["factor"] == first["factor"] == 2.0
    np.testing.assert_array_equal(again["x"], first["x"])
    np.testing.assert_array_equal(again["x"], 2 * x)


def test_a_program_that_was_prepared_is_not_traced_when_it_is_called(folder):
    function, x = kept_jit(scaled), np.arange(3.0, dtype=np.float32)
    programs.prepare(function, 2.0, x)
    assert TRACED == [2.0]
    np.testing.assert_array_equal(function(2.0, -x)["x"], -2 * x)
    assert TRACED == [2.0]


@pytest.mark.parametrize("other", [(3.0, np.ones(3, "f4")), (2.0, np.ones(4, "f4")), (2.0, np.ones(3, "i4"))])
def test_other_arguments_ask_for_another_program(folder, other):
    called(2.0, np.ones(3, "f4"))
    found, traced = called(*other)
    assert traced
    np.testing.assert_array_equal(found["x"], other[0] * other[1])
    assert len(kept(folder)) == 2


@pytest.mark.parametrize("part", ["source_digest", "_environment", "_context"])
def test_other_code_machines_and_settings_ask_for_another_program(folder, monkeypatch, part):
    called(2.0, np.ones(3))
    monkeypatch.setattr(programs, part, lambda *_: ("another",))
    assert called(2.0, np.ones(3))[1]


def test_a_change_of_the_source_that_leaves_a_program_as_it_was_compiles_nothing(folder, monkeypatch):
    x = np.arange(3.0, dtype=np.float32)
    called(2.0, x)
    monkeypatch.setattr(programs, "source_digest", lambda package: "another")
    monkeypatch.setitem(NUMBERS, "of", "y")
    with monkeypatch.context() as inner:
        inner.setattr(jax.stages.Lowered, "compile", None)
        found, traced = called(2.0, x)
        assert traced
        assert found["of"] == "y"
        np.testing.assert_array_equal(found["x"], 2 * x)
        assert not called(2.0, x)[1]
    monkeypatch.setattr(programs, "source_digest", lambda package: "a third")
    monkeypatch.setitem(NUMBERS, "unit", 3.0)
    np.testing.assert_array_equal(called(2.0, x)[0]["x"], 6 * x)
    assert len(kept(folder)) == 3


def test_precision_asks_for_another_program(folder):
    called(2.0, np.ones(3))
    with jax.enable_x64(jnp.result_type(float) == jnp.float32):
        found, traced = called(2.0, np.ones(3))
        assert traced
        assert found["x"].dtype == jnp.result_type(float)


class Named(eqx.Module):
    x: jax.Array
    names: tuple[str, str] = eqx.field(static=True)


def test_equal_values_ask_for_the_same_program_whether_or_not_they_are_one_object(folder):
    one, other = "".join(["na", "me"]), "".join(["na", "me"])
    assert one is not other
    for names in ((one, one), (one, other)):
        kept_jit(identity)(Named(jnp.ones(3), names))
    assert len(kept(folder)) == 1


DAMAGES = {"cut": lambda data: data[:-9], "empty": lambda data: b"", "changed": lambda data: data[:-9] + bytes(9)}


@pytest.mark.parametrize("damage", DAMAGES.values(), ids=DAMAGES)
def test_a_damaged_program_is_compiled_anew(folder, damage):
    called(2.0, np.ones(3))
    (path,) = kept(folder)
    path.write_bytes(damage(whole := path.read_bytes()))
    forget(path)
    found, traced = called(2.0, np.ones(3))
    assert traced
    np.testing.assert_array_equal(found["x"], 2 * np.ones(3))
    assert len(path.read_bytes()) > len(whole) / 2
    assert not called(2.0, np.ones(3))[1]


def test_what_names_do_not_describe_is_not_kept(folder):
    class Local(eqx.Module):
        gain: jax.Array

    shift = 1.0
    np.testing.assert_array_equal(kept_jit(lambda x: x + shift)(np.ones(3)), 2 * np.ones(3))
    assert called(2.0, np.ones(3))[1]
    assert len(kept(folder)) == 1
    np.testing.assert_array_equal(kept_jit(identity)(Local(jnp.ones(3))).gain, jnp.ones(3))
    assert len(kept(folder)) == 1


def identity(x):
    return x


def test_another_package_named_as_one_of_ours_is_not_kept(folder, monkeypatch):
    assert programs._is_ours_or_a_library("experiments")
    monkeypatch.setattr(programs, "OWN", (*programs.OWN, "json"))
    programs._is_ours_or_a_library.cache_clear()
    assert not programs._is_ours_or_a_library("json")


def test_it_transforms_as_filter_jit_does(folder):
    double = kept_jit(twice)
    np.testing.assert_allclose(jax.grad(lambda x: double(x).sum())(jnp.ones(3)), 2 * np.ones(3))
    np.testing.assert_allclose(jax.vmap(double)(jnp.ones((2, 3))), 2 * np.ones((2, 3)))
    assert not kept(folder)


def twice(x):
    return 2 * x


def test_nothing_is_kept_before_a_folder_is_configured(folder, monkeypatch):
    monkeypatch.setattr(runtime, "_kept", [])
    called(2.0, np.ones(3))
    assert not kept(folder)


ADAPT = """
import jax
import numpy as np
import hybrid_jax as hj
hj.runtime.configure()
draw = np.random.default_rng(0).normal
x0 = np.zeros((20, 13), "f4")
x0[:, :3], x0[:, 6] = draw(size=(20, 3)), 1
u = (600 + 50 * draw(size=(20, 10, 4))).astype("f4")
body = hj.rigid_body(hj.IRIS)
windows = hj.Trajectories(x0, u, np.asarray(hj.rollout_batch(body, x0, u, 0.01)), 0.01)
traced = []
jax.monitoring.register_event_duration_secs_listener(
    lambda name, _, **about: traced.append(about.get("fun_name")) if name.endswith("trace_duration") else None
)
result = hj.adapt(body, windows)
print(result.report())
print([name for name in traced if name and "solution" in name])
"""


@pytest.mark.slow
def test_a_new_process_adapts_as_the_first_one_did(tmp_path):
    # It calls LAPACK, which a process that lowered nothing has not set up.
    own = os.environ | {runtime.PROGRAMS: str(tmp_path)}  # not where the tests before this one kept theirs
    first, again = (script("-c", ADAPT, env=own).rpartition("\n[") for _ in range(2))
    assert again[0] == first[0]
    assert "solution" in first[2]
    assert again[2].strip() == "]"  # nothing of this name was traced


def test_programs_that_nobody_used_for_a_month_are_deleted(folder):
    called(2.0, np.ones(3))
    called(3.0, np.ones(3))
    old, new = kept(folder)
    os.utime(old, (0, 0))
    runtime._delete_unused(folder)
    assert kept(folder) == [new]


def test_programs_used_longest_ago_make_room(folder, monkeypatch):
    for factor in (2.0, 3.0, 4.0):
        called(factor, np.ones(3))
    old, *others = kept(folder)
    os.utime(old, (now := time.time(), now - 60))
    monkeypatch.setattr(runtime, "MOST", sum(path.stat().st_size for path in others))
    runtime._delete_unused(folder)
    assert kept(folder) == others
