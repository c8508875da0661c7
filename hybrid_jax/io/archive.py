"""Named arrays and a JSON header in one file: no pickle, a checksum of its own, the same bytes for the same content."""

import hashlib
import io
import json
import math
import zipfile
from collections.abc import Mapping
from pathlib import Path, PurePosixPath
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import PyTree

from hybrid_jax.checks import first_line
from hybrid_jax.io.files import write_whole

HEADER = "header.json"
NUMERIC = "biufc"  # kinds of NumPy types that are kept
Arrays = Mapping[str, np.ndarray]


def save_archive(path: str | Path, form: str, metadata: Any, arrays: Arrays) -> None:
    """Write an archive whole or not at all.

    Args:
        form: what kind of archive it is, and the version of that kind; the reader asks for the same.

    Raises:
        ValueError: the metadata are not JSON, or an array is not of numbers.
        OSError: the folder cannot be written.
    """
    for name, array in arrays.items():
        if array.dtype.kind not in NUMERIC:
            raise ValueError(f"array {name!r} is of {array.dtype}, which cannot be saved")
    header = {"format": form, "sha256": digest(metadata, arrays), "metadata": metadata}
    buffer = io.BytesIO()
    # An .npz is a zip of .npy; entries made by hand carry no clock, so equal content gives equal bytes.
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_STORED) as archive:
        archive.writestr(zipfile.ZipInfo(HEADER), encode(header))
        for name, array in arrays.items():
            with archive.open(zipfile.ZipInfo(f"{name}.npy"), "w", force_zip64=True) as entry:
                np.lib.format.write_array(entry, _contiguous(array), allow_pickle=False)
    write_whole(path, buffer.getvalue())


def load_archive(path: str | Path, form: str) -> tuple[Any, dict[str, np.ndarray]]:
    """The metadata and arrays of an archive, verified.

    Raises:
        ValueError: the file is missing, truncated, of another kind or damaged; one line that names the file.
    """
    path = Path(path)
    try:
        entries = _read_entries(path)
        header = json.loads(entries.pop(HEADER, b"{}"))
        if not isinstance(header, dict) or header.get("format") != form:
            raise ValueError(f"has no header of {form!r}")
        arrays = {name.removesuffix(".npy"): _read_array(name, entry) for name, entry in entries.items()}
        found = digest(header.get("metadata"), arrays)
    except FileNotFoundError as error:
        raise ValueError(f"{path}: no such file") from error
    except (zipfile.BadZipFile, EOFError, OSError, ValueError, RuntimeError, OverflowError) as error:
        raise ValueError(
            f"{path}: truncated, damaged or not a {form.rsplit(' ', 1)[0]}: {first_line(error)}"
        ) from error
    if header.get("sha256") != found:
        raise ValueError(f"{path}: checksum differs from the one recorded: the file is damaged or was altered")
    return header.get("metadata"), arrays


def digest(metadata: Any, arrays: Arrays) -> str:
    """SHA-256 (hex) over metadata, whatever the order of their keys, and names, types, shapes and bytes of arrays.

    Raises:
        ValueError: the metadata are not JSON.
    """
    found = hashlib.sha256(encode(metadata, sort_keys=True, separators=(",", ":")))
    for name in sorted(arrays):
        array = _contiguous(arrays[name])
        found.update(encode([name, array.dtype.str, list(array.shape)]))
        found.update(array.tobytes())
    return found.hexdigest()


def encode(value: Any, **layout: Any) -> bytes:
    """Strict JSON as bytes.

    Raises:
        ValueError: the value has no JSON form.
    """
    try:
        return json.dumps(value, allow_nan=False, **layout).encode()
    except (TypeError, ValueError, RecursionError) as error:
        raise ValueError(f"configuration and metadata must be JSON: {error}") from error


def named_leaves(tree: PyTree) -> dict[str, np.ndarray]:
    """The arrays of a tree by their path in it."""
    leaves, _ = jax.tree_util.tree_flatten_with_path(eqx.filter(tree, eqx.is_array))
    return {jax.tree_util.keystr(path, simple=True, separator="/"): np.asarray(leaf) for path, leaf in leaves}


def with_leaves(like: PyTree, arrays: Arrays, origin: str | Path) -> PyTree:
    """The tree `like` with its arrays replaced by those of the same path.

    Raises:
        ValueError: other paths, shapes or types; names `origin` and the first that differs.
    """
    expected = named_leaves(like)
    for name in sorted(expected.keys() | arrays.keys()):
        want, have = expected.get(name), arrays.get(name)
        if want is None or have is None or (want.shape, want.dtype) != (have.shape, have.dtype):
            found = "absent" if have is None else f"{have.dtype}{list(have.shape)}"
            wanted = "none" if want is None else f"{want.dtype}{list(want.shape)}"
            raise ValueError(f"{origin}: array {name!r} is {found}, expected {wanted}")
    whole, rest = eqx.partition(like, eqx.is_array)
    paths, structure = jax.tree_util.tree_flatten_with_path(whole)
    names = [jax.tree_util.keystr(path, simple=True, separator="/") for path, _ in paths]
    return eqx.combine(jax.tree.unflatten(structure, [arrays[name] for name in names]), rest)


def _read_entries(path: Path) -> dict[str, bytes]:
    """The bytes of each entry by its name.

    Nothing is written, so no name leads anywhere; one that would was not written here. Nor is a compressed entry, with
    which a small file could fill the memory.
    """
    with zipfile.ZipFile(path) as archive:
        for entry in archive.infolist():
            place = PurePosixPath(entry.filename.replace("\\", "/"))
            if place.is_absolute() or ".." in place.parts:
                raise ValueError(f"entry {entry.filename!r} leads out of the file's folder")
            if entry.compress_type != zipfile.ZIP_STORED or entry.compress_size != entry.file_size:
                raise ValueError(f"entry {entry.filename!r} is compressed")
        if sum(entry.file_size for entry in archive.infolist()) > path.stat().st_size:
            raise ValueError("its entries declare more than the file holds")
        # Reading an entry whole verifies its CRC.
        return {name: archive.read(name) for name in archive.namelist()}


def _read_array(name: str, entry: bytes) -> np.ndarray:
    """The array of numbers in a .npy, whose header is believed only if it declares what is there."""
    file = io.BytesIO(entry)
    if np.lib.format.read_magic(file) != (1, 0):
        raise ValueError(f"entry {name!r} is a .npy of a version that is not written here")
    shape, in_fortran_order, dtype = np.lib.format.read_array_header_1_0(file)
    declared = math.prod(shape) * dtype.itemsize if min(shape, default=0) >= 0 else None
    if dtype.kind not in NUMERIC or declared != len(entry) - file.tell():
        raise ValueError(f"entry {name!r} holds no numbers, or other than {dtype}{list(shape)}, as it declares")
    order = "F" if in_fortran_order else "C"
    return np.ndarray(shape, dtype, entry, file.tell(), order=order).copy(order)


def _contiguous(array: np.ndarray) -> np.ndarray:
    # np.ascontiguousarray would make a vector of a scalar.
    return np.asarray(array, order="C")
