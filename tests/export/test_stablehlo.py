"""A program in a file is the field, for whoever reads it; anything else is refused in one line."""

import fields
import jax
import jax.export
import jax.numpy as jnp
import numpy as np
import pytest
import surface
from fields import SIZES, body, field_of, samples, solved

from hybrid_jax import rollout_batch, save
from hybrid_jax.export import export_program, load_program
from hybrid_jax.export.stablehlo import FORMAT
from hybrid_jax.io.files import save_archive

KINDS = ("rigid body", "multirotor, per rotor", "hybrid, norm batch", "residual from body to accelerations", "hold")


@pytest.fixture
def path(tmp_path):
    return tmp_path / "program.npz"


def refusal(path, what=load_program):
    return surface.refusal(lambda: what(path))


def close(found, expected):
    fields.close(found, expected, 2e-6)  # some roundings of 6e-8
    assert found.dtype == np.float32


@pytest.mark.parametrize("name", KINDS)
def test_a_program_is_the_field(name, path):
    export_program(path, field_of(name), **SIZES, about={"seed": 3})
    program = load_program(path)
    for x, u in zip(*samples(2), strict=True):
        close(program(x, u), field_of(name)(jnp.asarray(x, jnp.float32), jnp.asarray(u, jnp.float32)))
    assert (program.dt, program.state_size, program.input_size) == (None, 13, 4)
    assert (program.batched, program.platforms, program.about) == (False, ("cpu",), {"seed": 3})


@pytest.mark.parametrize("name", ["multirotor, per rotor", "hybrid, norm batch"])
def test_a_program_of_steps_is_an_interval_of_a_rollout_for_a_batch_of_any_length(name, path):
    export_program(path, field_of(name), 0.02, batched=True)
    program = load_program(path)
    assert (program.dt, program.batched) == (0.02, True)
    for count in (1, 3):
        x, u = (part.astype(np.float32) for part in samples(count))
        close(program(x, u), rollout_batch(field_of(name), x, u[:, None], 0.02)[:, 0])


def test_in_double_precision_it_stays_single(path):
    single, (x, u) = body(), (part[0] for part in samples())
    with jax.enable_x64(True):
        export_program(path, jax.tree.map(lambda leaf: jnp.asarray(leaf, float), single))
        close(load_program(path)(x, u), single(*(jnp.asarray(a, jnp.float32) for a in (x, u))))


def test_equal_fields_are_equal_files_that_name_no_file_of_the_writer_but_two_platforms(path, tmp_path):
    for name in ("one.npz", "two.npz"):
        export_program(tmp_path / name, field_of("hybrid, norm batch"), 0.01, batched=True)
    content = (tmp_path / "one.npz").read_bytes()
    assert content == (tmp_path / "two.npz").read_bytes()
    assert b".py" not in content.replace(b"exported.npy", b"")
    export_program(path, field_of("hybrid, norm batch"), 0.01, platforms=("cpu", "cuda"))
    assert load_program(path).platforms == ("cpu", "cuda")


def forged(path, function, *shapes, **metadata):
    """A file with the right checksum that holds another program."""
    likes = [jax.ShapeDtypeStruct(shape, jnp.float32) for shape in shapes]
    content = np.frombuffer(jax.export.export(jax.jit(function))(*likes).serialize(), np.uint8)
    save_archive(path, FORMAT, {"dt": None, "about": {}} | metadata, {"exported": content})
    return path


def test_what_is_no_program_or_a_forged_one_is_refused_by_its_name_and_so_is_what_makes_none(path):
    assert "must be JSON" in refusal(path, lambda path: export_program(path, body(), about={"a": np.ones(2)}))
    assert "calls lapack" in refusal(path, lambda path: export_program(path, solved, **SIZES))
    assert "no such file" in refusal(path)
    save(path, body())
    assert "not a hybrid_jax program" in refusal(path)
    for arrays in ({}, {"exported": np.zeros(0, np.uint8)}, {"exported": np.full(400, 7, np.uint8)}):
        save_archive(path, FORMAT, {"dt": None, "about": {}}, arrays)
        assert f"{path}: not a program" in refusal(path)
    d, m = (13,), (4,)
    assert "calls lapack" in refusal(forged(path, solved, d, m))
    assert "the program must map" in refusal(forged(path, lambda x, u: x[:2], d, m))
    assert "not a program" in refusal(forged(path, lambda x: x, d))
    assert "dt must be" in refusal(forged(path, lambda x, u: x, d, m, dt="0.01"))
    assert "not a program" in refusal(forged(path, lambda x, u: x, d, m, about=3))
