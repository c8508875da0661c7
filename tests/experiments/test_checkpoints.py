"""Checkpoints of a sweep: two are kept, a damaged one is set aside, and no flipped bit is believed."""

import random
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from experiments.runner.checkpoint import Checkpoints

ARRAYS = {
    "field/weight": np.random.default_rng(0).normal(size=(3, 50)).astype(np.float32),
    "epoch": np.array([3, 4, 5], np.int32),
    "scalar": np.array(np.nan),
    "key": np.array([[1, 2**32 - 1]], np.uint32),
}


def saved(folder, count):
    """Checkpoints of that many saves, each with its number."""
    checkpoints = Checkpoints(folder)
    for number in range(1, count + 1):
        checkpoints.save(ARRAYS, {"number": number})
    return checkpoints


def loaded(folder):
    """What a new process would find, and what it would say."""
    said = []
    return Checkpoints(folder).load(said.append), said


def names(folder):
    return sorted(path.name for path in folder.iterdir())


def test_what_is_loaded_is_the_last_save_bit_for_bit(tmp_path):
    saved(tmp_path, 3)
    (arrays, about), said = loaded(tmp_path)
    assert about == {"number": 3}
    assert said == []
    assert arrays.keys() == ARRAYS.keys()
    for name, array in ARRAYS.items():
        assert (arrays[name].dtype, arrays[name].shape) == (array.dtype, array.shape)
        assert arrays[name].tobytes() == array.tobytes()


def test_the_last_two_are_kept(tmp_path):
    saved(tmp_path, 4)
    assert names(tmp_path) == ["000003", "000004"]


def test_nothing_saved_is_nothing_found(tmp_path):
    assert loaded(tmp_path / "absent") == (None, [])


@pytest.mark.filterwarnings("ignore::RuntimeWarning", "ignore::pytest.PytestUnraisableExceptionWarning")  # of orbax
def test_no_flipped_bit_is_believed(tmp_path):
    """A bit in every file of a checkpoint, each in turn: what is loaded is exact, or the checkpoint before it."""
    saved(tmp_path, 2)
    rng, refused = random.Random(0), 0
    for file in sorted(path for path in (tmp_path / "000002").rglob("*") if path.is_file() and path.stat().st_size):
        content = bytearray(file.read_bytes())
        place = rng.randrange(len(content))
        content[place] ^= 1 << rng.randrange(8)
        whole = file.read_bytes()
        file.write_bytes(content)
        (arrays, about), said = loaded(tmp_path)
        assert all(arrays[name].tobytes() == ARRAYS[name].tobytes() for name in ARRAYS)
        assert about == {"number": 2 - len(said)}
        for aside in tmp_path.glob("000002.damaged-*"):
            aside.rename(tmp_path / "000002")
            refused += 1
        file.write_bytes(whole)
    assert refused >= 3  # among them the arrays and what is said about them
    assert loaded(tmp_path)[0][1] == {"number": 2}


@pytest.mark.parametrize("left", [0.0, 0.5])
def test_a_truncated_checkpoint_is_named_and_set_aside(left, tmp_path):
    saved(tmp_path, 2)
    for file in (tmp_path / "000002").rglob("*"):
        if file.is_file():
            file.write_bytes(file.read_bytes()[: int(left * file.stat().st_size)])
    (_, about), said = loaded(tmp_path)
    assert about == {"number": 1}
    (line,) = said
    assert line.startswith(f"{tmp_path / '000002'}: truncated or damaged, set aside as 000002.damaged-")
    assert [name.split("-")[0] for name in names(tmp_path)] == ["000001", "000002.damaged"]


def test_the_next_save_follows_what_was_set_aside(tmp_path):
    saved(tmp_path, 2)
    (tmp_path / "000002" / "about" / "metadata").write_text("{")
    loaded(tmp_path)
    Checkpoints(tmp_path).save(ARRAYS, {"number": 9})
    assert loaded(tmp_path)[0][1] == {"number": 9}


def test_deleting_leaves_what_was_set_aside(tmp_path):
    saved(tmp_path / "one", 2).delete()
    assert not (tmp_path / "one").exists()
    two = saved(tmp_path / "two", 2)
    (tmp_path / "two" / "000002" / "about" / "metadata").write_text("{")
    two.load(lambda line: None)
    two.delete()
    assert [name.split("-")[0] for name in names(tmp_path / "two")] == ["000002.damaged"]


FULL = """
import resource, sys, numpy as np
from pathlib import Path
from experiments.runner.checkpoint import Checkpoints
resource.setrlimit(resource.RLIMIT_FSIZE, (3000, resource.RLIM_INFINITY))  # no file may grow beyond 3 kB
try:
    Checkpoints(Path(sys.argv[1])).save({"large": np.random.default_rng(0).normal(size=10_000)}, {})
except OSError as error:
    sys.exit(str(error))
"""


def test_a_full_disk_leaves_what_was_saved(tmp_path):
    saved(tmp_path, 2)
    full = subprocess.run(
        [sys.executable, "-c", FULL, str(tmp_path)], capture_output=True, text=True, cwd=Path(__file__).parents[2]
    )
    assert full.returncode == 1
    assert len(full.stderr.splitlines()) == 1
    assert "000003: the state cannot be saved: File too large" in full.stderr
    assert loaded(tmp_path)[0][1] == {"number": 2}
    # A thread of orbax that hears late of the failure may leave a folder behind, until the next save.
    Checkpoints(tmp_path).save(ARRAYS, {"number": 3})
    assert names(tmp_path) == ["000002", "000003"]
