"""Archives that another wrote end in one line with the file's name, whatever they hold."""

import json
import os
import zipfile

import numpy as np
import pytest

import hybrid_jax as hj
from hybrid_jax.io.archive import HEADER, load_archive


def npy(header):
    text = header.encode()
    return b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text


@pytest.mark.parametrize("header", ["(True,)", "[" * 5000, "{'descr': '<f4', 'shape': (2,)", "\x00"])
def test_a_header_that_is_none_is_refused_with_the_name_of_the_file(header, tmp_path):
    path = tmp_path / "odd.npz"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr(HEADER, json.dumps({"format": "any 1"}))
        archive.writestr("array.npy", npy(header))
    with pytest.raises(ValueError, match=r"odd\.npz: .* entry 'array.npy' is no array"):
        load_archive(path, "any 1")


def test_a_pipe_is_refused_and_not_waited_for(tmp_path):
    os.mkfifo(tmp_path / "pipe.npz")
    with pytest.raises(ValueError, match=r"pipe\.npz"):
        hj.load(tmp_path / "pipe.npz")


def test_bytes_that_changed_are_noticed_or_harmless(tmp_path):
    """A few of the mutations that run by thousands elsewhere: one line, never another error."""
    path = tmp_path / "model.npz"
    hj.save(path, hj.rigid_body(hj.IRIS))
    whole, rng = bytearray(path.read_bytes()), np.random.default_rng(0)
    for _ in range(100):
        broken = whole.copy()
        for place in rng.integers(len(whole), size=rng.integers(1, 4)):
            broken[place] = rng.integers(256)
        path.write_bytes(broken[: rng.integers(1, len(whole) + 1)] if rng.random() < 0.3 else broken)
        said = "model.npz"
        try:
            hj.load(path)
        except ValueError as error:
            said = str(error)
        assert "model.npz" in said
