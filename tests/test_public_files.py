"""Whatever a file contains, it is read completely or refused in one line that names it; its code never runs."""

import io
import json
import os
import pickle
import zipfile

import numpy as np
import pytest
from surface import outcome

import hybrid_jax as hj
from hybrid_jax.export import load_program
from hybrid_jax.export.stablehlo import FORMAT as PROGRAM
from hybrid_jax.io.datasets import FORMAT as DATASET
from hybrid_jax.io.datasets import load_dataset
from hybrid_jax.io.models import FORMAT as MODEL


def npy(descr="<f8", shape="(2,)", data=bytes(16), version=1):
    """The bytes of a .npy with an arbitrary header."""
    header = f"{{'descr': {descr!r}, 'fortran_order': False, 'shape': {shape}, }}\n".encode()
    return b"\x93NUMPY" + bytes([version, 0]) + len(header).to_bytes(2, "little") + header + data


class Trap:
    """Makes a folder when it is unpickled."""

    def __init__(self, folder):
        self.folder = folder

    def __reduce__(self):
        return os.mkdir, (str(self.folder),)


def pickled(folder):
    file = io.BytesIO()
    np.lib.format.write_array(file, np.array([Trap(folder)], dtype=object), allow_pickle=True)
    return file.getvalue()


HOSTILE = {
    "absolute name": lambda folder: {str(folder / "sprung"): npy()},
    "name that climbs": lambda folder: {"../sprung.npy": npy()},
    "name that climbs from inside": lambda folder: {"a/../../sprung.npy": npy()},
    "name that climbs on Windows": lambda folder: {"..\\sprung.npy": npy()},
    "pickle in a .npy": lambda folder: {"a.npy": pickled(folder / "sprung")},
    "pickle": lambda folder: {"a.npy": pickle.dumps(Trap(folder / "sprung"))},
    "pickle as header": lambda folder: {"header.json": pickle.dumps(Trap(folder / "sprung"))},
    "array of terabytes": lambda folder: {"a.npy": npy(shape=f"({10**13},)")},
    "array whose size overflows": lambda folder: {"a.npy": npy(shape=f"({2**32}, {2**32})")},
    "array of negative size": lambda folder: {"a.npy": npy(shape="(-1, -2)")},
    "shape that is code": lambda folder: {"a.npy": npy(shape=f"(__import__('os').mkdir('{folder / 'sprung'}'),)")},
    "array of objects": lambda folder: {"a.npy": npy(descr="|O")},
    "another version of .npy": lambda folder: {"a.npy": npy(version=3)},
    "nested header": lambda folder: {"header.json": b"[" * 100_000},
    "header with NaN": lambda folder: {"header.json": b'{"format": "%s", "metadata": NaN}'},
    "header without end": lambda folder: {"header.json": b'{"format": "%s", "metadata": '},
}


@pytest.mark.parametrize("load", [hj.load, load_dataset, load_program])
@pytest.mark.parametrize("name", HOSTILE)
def test_a_hostile_file_is_refused_and_runs_and_writes_nothing(name, load, tmp_path):
    form = {hj.load: MODEL, load_dataset: DATASET, load_program: PROGRAM}[load]
    path = tmp_path / "inside" / "hostile.npz"
    path.parent.mkdir()
    with zipfile.ZipFile(path, "w") as archive:
        entries = {"header.json": json.dumps({"format": form}).encode()} | HOSTILE[name](tmp_path)
        for entry, content in entries.items():
            archive.writestr(entry, content.replace(b"%s", form.encode()))
    assert outcome(load, path, naming=str(path)) is None
    assert list(tmp_path.rglob("*")) == [path.parent, path]


def test_the_trap_would_spring_and_a_compressed_file_is_refused(tmp_path):
    np.load(io.BytesIO(pickled(tmp_path / "sprung")), allow_pickle=True)
    assert (tmp_path / "sprung").exists()  # else the test before would prove nothing
    path = tmp_path / "bomb.npz"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("header.json", bytes(10**7))
    with pytest.raises(ValueError, match="is compressed"):
        hj.load(path)
