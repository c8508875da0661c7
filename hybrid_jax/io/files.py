"""Atomic writes, and strict JSON."""

import json
import math
import os
import secrets
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from hybrid_jax.checks import content_of, first_line


def write_atomic(path: str | Path, content: str | bytes) -> None:
    """Write a new file beside `path`, text as UTF-8, then rename it; OSError leaves an earlier file unchanged."""
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
    except OSError as error:  # that of a full disk names no file
        raise OSError(f"{path}: cannot be saved: {error.strerror}; what was saved before is intact") from error
    finally:
        temporary.unlink(missing_ok=True)


def json_text(value: Any) -> str:
    return json.dumps(json_value(value), indent=1, allow_nan=False, ensure_ascii=False) + "\n"


def json_value(value: Any) -> Any:
    """The JSON form of nested mappings, sequences, arrays, paths and numbers. Non-finite numbers become null."""
    match value:
        case None | bool() | int() | str():
            return value
        case float():
            return value if math.isfinite(value) else None
        case np.generic() | np.ndarray():
            return json_value(value.tolist())
        case Path():
            return str(value)
        case Mapping():
            return {str(key): json_value(item) for key, item in value.items()}
        case Sequence() if not isinstance(value, bytes):
            return [json_value(item) for item in value]
    raise ValueError(f"{value!r} of type {type(value).__name__} has no JSON form")


def read_json(path: str | Path) -> Any:
    """Read a JSON file; one-line ValueError if it cannot be read or is not JSON (NaN and Infinity are not)."""

    def refuse(constant: str) -> None:
        raise ValueError(f"{constant} is not JSON")

    try:
        return json.loads(content_of(path), parse_constant=refuse)
    except OSError as error:
        raise ValueError(f"{path}: cannot be read: {error.strerror}") from error
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path}: truncated or not JSON: {first_line(error)}") from error
