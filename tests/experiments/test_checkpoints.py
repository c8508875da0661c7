"""A damaged checkpoint of a sweep is never loaded; a lost connection is deferred to the end of a block."""

import random
import signal

import numpy as np
import pytest

from experiments.runner.checkpoint import Checkpoints, DeferredSignals

ARRAYS = {
    "field/weight": np.random.default_rng(0).normal(size=(3, 50)).astype(np.float32),
    "epoch": np.array([3, 4, 5], np.int32), "scalar": np.array(np.nan), "key": np.array([[1, 2**32 - 1]], np.uint32),
}  # fmt: skip


def saved(folder, count):
    checkpoints = Checkpoints(folder)
    for number in range(1, count + 1):
        checkpoints.save({"number": number}, ARRAYS)
    return checkpoints


def loaded(folder):
    """What a new process loads, and its messages."""
    said = []
    return Checkpoints(folder).load(said.append), said


def names(folder):
    return sorted(path.name for path in folder.iterdir())


def test_the_last_save_is_loaded_bit_for_bit_two_are_kept_and_deleting_leaves_renamed_files(tmp_path):
    saved(tmp_path, 4)
    (about, arrays), said = loaded(tmp_path)
    assert (about, said) == ({"number": 4}, [])
    assert arrays.keys() == ARRAYS.keys()
    for name, array in ARRAYS.items():
        assert (arrays[name].dtype, arrays[name].shape) == (array.dtype, array.shape)
        assert arrays[name].tobytes() == array.tobytes()
    assert names(tmp_path) == ["000003.npz", "000004.npz"]
    assert loaded(tmp_path / "absent") == (None, [])
    saved(tmp_path / "one", 2).delete()
    assert not (tmp_path / "one").exists()
    two = saved(tmp_path / "two", 2)
    (tmp_path / "two" / ".000003.npz.1.part").touch()  # left by a kill
    (tmp_path / "two" / "000002.npz").write_text("{")
    two.load(lambda line: None)
    two.delete()
    assert [name.split("-")[0] for name in names(tmp_path / "two")] == ["000002.npz.damaged"]


def test_a_flipped_bit_and_a_missing_half_are_detected(tmp_path):
    saved(tmp_path, 2)
    file, rng = tmp_path / "000002.npz", random.Random(0)
    intact = file.read_bytes()
    for place in range(0, len(intact), 97):
        content = bytearray(intact)
        content[place] ^= 1 << rng.randrange(8)
        file.write_bytes(content)
        (about, arrays), said = loaded(tmp_path)
        assert all(line.startswith(f"{file}: truncated, damaged or not a hybrid_jax checkpoint") for line in said)
        assert all(arrays[name].tobytes() == ARRAYS[name].tobytes() for name in ARRAYS)
        assert about == {"number": 2 - len(said)}
    assert len(list(tmp_path.glob("000002.npz.damaged-*"))) > 10
    file.write_bytes(intact[: len(intact) // 2])
    assert loaded(tmp_path)[0][0] == {"number": 1}
    Checkpoints(tmp_path).save({"number": 9}, ARRAYS)
    assert loaded(tmp_path)[0][0] == {"number": 9}


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_a_lost_connection_is_deferred_like_an_end(number):
    met = []
    before = signal.signal(number, lambda *_: met.append(number))
    try:
        with DeferredSignals() as signals:
            signal.raise_signal(number)
            assert signals.pending == number
            assert not met
        assert met == [number]
    finally:
        signal.signal(number, before)
