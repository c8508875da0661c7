"""Files that are written whole or not at all, and JSON that any reader accepts."""

import itertools
import json
import math
import os
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np


def write_whole(path: str | Path, content: str | bytes) -> None:
    """Write a neighbour of the file, then put it in the file's place in one step; text is UTF-8.

    Raises:
        OSError: the folder cannot be made or written, or is full; what stood at `path` is untouched.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        with temporary.open("wb") as file:
            file.write(content.encode() if isinstance(content, str) else content)
            file.flush()
            os.fsync(file.fileno())  # or a power cut could leave the new name on no content
        os.replace(temporary, path)
    except OSError as error:
        # A full disk names no file.
        raise OSError(f"{path}: cannot be saved: {error.strerror}; what was saved before is intact") from error
    finally:
        temporary.unlink(missing_ok=True)


def backup_path(path: Path, reason: str) -> Path:
    """A free name beside `path` with the reason and the time (UTC), for what must give way and not be deleted."""
    stem = f"{path.name}.{reason}-{datetime.now(UTC):%Y%m%dT%H%M%SZ}"
    names = itertools.chain([stem], (f"{stem}-{i}" for i in itertools.count(2)))
    return next(free for free in map(path.with_name, names) if not free.exists())


def json_text(value: Any) -> str:
    """Indented JSON of `json_value(value)`, ending in a newline."""
    return json.dumps(json_value(value), indent=1, allow_nan=False, ensure_ascii=False) + "\n"


def json_value(value: Any) -> Any:
    """The JSON form of nested mappings, sequences, arrays, paths and numbers; a number that is not finite is null.

    Raises:
        ValueError: a value of another type, named with its type.
    """
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
    """The content of a JSON file; NaN and Infinity, which are not JSON, are refused.

    Raises:
        ValueError: the file cannot be read, or is truncated or otherwise not JSON; one line.
    """
    try:
        return json.loads(Path(path).read_bytes(), parse_constant=_refuse)
    except OSError as error:
        raise ValueError(f"{path}: cannot be read: {error.strerror}") from error
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path}: truncated or not JSON: {error}") from error


def _refuse(constant: str) -> None:
    raise ValueError(f"{constant} is not JSON")
