"""Atomic writes, strict JSON, and archives of named arrays and JSON metadata in a reproducible file, without pickle."""

import hashlib
import io
import json
import math
import os
import secrets
import time
import zipfile
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path, PurePosixPath
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from hybrid_jax.checks import first_line

HEADER = "header.json"
NUMERIC = {np.dtype(kind) for kind in "?bhilqBHILQefdFD"}
# JAX's own number types, which .npy does not support, are stored as integers of the same size.
EXTENDED = {np.dtype(kind).name: np.dtype(kind) for kind in (jnp.bfloat16, jnp.float8_e4m3fn, jnp.float8_e5m2)}
Arrays = Mapping[str, np.ndarray]


def write_atomic(path: str | Path, content: str | bytes) -> None:
    """Write a new file beside `path`, with text as UTF-8, and rename it; OSError leaves an earlier file unchanged."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{secrets.token_hex(8)}.part")
    try:
        for left in path.parent.glob(f".{16 * '[0-9a-f]'}.part"):
            with suppress(OSError):
                if left.lstat().st_mtime < time.time() - 3600:
                    left.unlink()
        with temporary.open("xb") as file:
            file.write(content.encode() if isinstance(content, str) else content)
            file.flush()
            os.fsync(file.fileno())  # otherwise a power cut could leave an empty file
        os.replace(temporary, path)
    except OSError as error:  # the error of a full disk does not name the file
        raise OSError(f"{path}: cannot be saved: {error.strerror}; what was saved before is intact") from error
    finally:
        temporary.unlink(missing_ok=True)


def json_text(value: Any) -> str:
    return json.dumps(json_value(value), indent=1, allow_nan=False, ensure_ascii=False) + "\n"


def json_value(value: Any) -> Any:
    """Convert nested mappings, sequences, arrays, paths and numbers to JSON values. Non-finite numbers become null."""
    match value:
        case None | bool() | int() | str():
            return value
        case float():
            return value if math.isfinite(value) else None
        case np.generic() if value.dtype == np.float32:
            return json_value(float(str(value)))  # its own nine digits; it has no more
        case np.generic() | np.ndarray():
            return json_value(value.tolist())
        case Path():
            return str(value)
        case Mapping():
            return {str(key): json_value(item) for key, item in value.items()}
        case Sequence() if not isinstance(value, bytes):
            return [json_value(item) for item in value]
    raise ValueError(f"{value!r} of type {type(value).__name__} has no JSON form")


def save_archive(path: str | Path, form: str, metadata: Any, arrays: Arrays) -> None:
    """Write an archive of a form, for example "hybrid_jax model 2", atomically; ValueError if it cannot be saved."""
    for name, array in arrays.items():
        if array.dtype.newbyteorder("=") not in NUMERIC:
            raise ValueError(f"array {name!r} has type {array.dtype}, which cannot be saved")
    header, buffer = {"format": form, "sha256": digest(metadata, arrays), "metadata": metadata}, io.BytesIO()
    # An .npz is a zip of .npy. Entries made by hand have no time stamp, so equal content gives equal bytes.
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_STORED) as archive:
        archive.writestr(zipfile.ZipInfo(HEADER), encode(header))
        for name, array in arrays.items():
            with archive.open(zipfile.ZipInfo(f"{name}.npy"), "w", force_zip64=True) as entry:
                np.lib.format.write_array(entry, np.asarray(array, order="C"), allow_pickle=False)
    write_atomic(path, buffer.getvalue())


def load_archive(path: str | Path, *forms: str) -> tuple[Any, dict[str, np.ndarray]]:
    """Read metadata and arrays from an archive of one of these forms; ValueError of one line if a check fails."""
    path = Path(path)
    try:
        entries = _read_entries(path)
        header = json.loads(entries.pop(HEADER, b"{}"))
        if not isinstance(header, dict) or header.get("format") not in forms:
            raise ValueError(f"no header of {forms[0]!r}")
        arrays = {name.removesuffix(".npy"): _read_array(name, entry) for name, entry in entries.items()}
        found = digest(header.get("metadata"), arrays)
    except FileNotFoundError as error:
        raise ValueError(f"{path}: no such file") from error
    except (zipfile.BadZipFile, EOFError, OSError, ValueError, RuntimeError, OverflowError, MemoryError) as error:
        kind = forms[0].rpartition(" ")[0]
        raise ValueError(f"{path}: truncated, damaged or not a {kind}: {first_line(error)}") from error
    if header.get("sha256") != found:
        raise ValueError(f"{path}: checksum differs from the one recorded: the file is damaged or was altered")
    return header.get("metadata"), arrays


def digest(metadata: Any, arrays: Arrays) -> str:
    """Return the SHA-256 (hex) of arrays and of metadata as strict JSON, independent of the order of keys and names."""
    found = hashlib.sha256(encode(metadata, sort_keys=True, separators=(",", ":")))
    for name in sorted(arrays):
        array = np.asarray(arrays[name], order="C")  # np.ascontiguousarray would add an axis to a scalar
        found.update(encode([name, array.dtype.str, list(array.shape)]))
        found.update(array.tobytes())
    return found.hexdigest()


def encode(value: Any, **layout: Any) -> bytes:
    """Encode a value as strict JSON; ValueError if this is impossible."""
    try:
        return json.dumps(value, allow_nan=False, **layout).encode()
    except (TypeError, ValueError, RecursionError) as error:
        raise ValueError(f"configuration and metadata must be JSON: {error}") from error


def named_leaves(tree: PyTree) -> dict[str, np.ndarray]:
    """Return the arrays of a tree as NumPy arrays, by path; ValueError if two have the same path."""
    named = {}
    for keys, leaf in jax.tree_util.tree_leaves_with_path(eqx.filter(tree, eqx.is_array)):
        path = jax.tree_util.keystr(keys, simple=True, separator="/")
        if path in named:
            raise ValueError(f"two arrays have the path {path!r}: no key of a dictionary may contain '/'")
        named[path] = to_numpy(leaf)
    return named


def with_leaves(like: PyTree, arrays: Arrays, origin: str | Path | None = None) -> PyTree:
    """Replace each array of `like` by the one at its path; ValueError, with `origin`, if one does not match."""
    expected = named_leaves(like)
    found, wanted = ({name: f"{a.dtype}{list(a.shape)}" for name, a in side.items()} for side in (arrays, expected))
    for name in sorted(expected.keys() | arrays.keys()):
        if found.get(name) != wanted.get(name):
            where = "" if origin is None else f"{origin}: "
            difference = f"is {found.get(name, 'absent')}, expected {wanted.get(name, 'none')}"
            raise ValueError(f"{where}array {name!r} {difference}")
    dynamic, rest = eqx.partition(like, eqx.is_array)
    leaves, structure = jax.tree.flatten(dynamic)
    filled = [from_numpy(arrays[path], array_type(leaf)) for path, leaf in zip(expected, leaves, strict=True)]
    return eqx.combine(jax.tree.unflatten(structure, filled), rest)


def array_type(array: Any) -> dict[str, str]:
    """Return what `to_numpy` loses: the algorithm of a random key, or a type in `EXTENDED`."""
    if jnp.issubdtype(array.dtype, jax.dtypes.prng_key):
        return {"key": str(jax.random.key_impl(array))}
    return {"dtype": array.dtype.name} if array.dtype.name in EXTENDED else {}


def to_numpy(array: Any) -> np.ndarray:
    kind = array_type(array)
    stored = np.asarray(jax.random.key_data(array) if "key" in kind else array)
    return stored.view(f"u{stored.itemsize}") if "dtype" in kind else stored


def from_numpy(array: np.ndarray, kind: Mapping[str, str]) -> Any:
    if "key" in kind:
        return jax.random.wrap_key_data(jnp.asarray(array), impl=kind["key"])
    return array.view(EXTENDED[kind["dtype"]]) if "dtype" in kind else array


def _read_entries(path: Path) -> dict[str, bytes]:
    """Read each entry by name; ValueError for paths outside the folder and for compression."""
    if path.exists() and not path.is_file():
        raise ValueError("not a regular file")  # a pipe or a device may never end
    with zipfile.ZipFile(path) as archive:
        for entry in archive.infolist():
            place = PurePosixPath(entry.filename.replace("\\", "/"))
            if place.is_absolute() or ".." in place.parts:
                raise ValueError(f"entry {entry.filename!r} leads out of the file's folder")
            if entry.compress_type != zipfile.ZIP_STORED or entry.compress_size != entry.file_size:
                raise ValueError(f"entry {entry.filename!r} is compressed")
        if sum(entry.file_size for entry in archive.infolist()) > path.stat().st_size:
            raise ValueError("its entries declare more than the file contains")
        return {name: archive.read(name) for name in archive.namelist()}  # which verifies the CRC of each


def _read_array(name: str, entry: bytes) -> np.ndarray:
    try:
        array = np.lib.format.read_array(io.BytesIO(entry), allow_pickle=False)
    except Exception as error:  # NumPy parses the header as Python, which fails in many ways
        raise ValueError(f"entry {name!r} is not an array: {error}") from error
    if array.dtype.newbyteorder("=") not in NUMERIC:
        raise ValueError(f"entry {name!r} is not numeric")
    return array
