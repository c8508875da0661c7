"""What a folder of results is about: run.json, by which an unfinished run goes on as itself or not at all."""

import hashlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from experiments.paper.config import Run
from experiments.reporting.environment import PACKAGES
from hybrid_jax.io.datasets import versions
from hybrid_jax.io.files import backup_path, json_text, json_value, read_json, write_atomic

FILE = "run.json"
FIXED = ("config", "versions", "flights")  # what must be the same for a run to go on
ANEW = "--fresh starts anew and moves it aside"


class OtherRun(ValueError):
    """What was begun differs from what is asked for; the message has a line for each difference."""


@contextmanager
def recorded(folder: Path, config: Run, say: Callable[[str], None]) -> Iterator[None]:
    """Note in a folder that a run was begun there, and at the end that it is finished.

    A run that ends in bad input was not begun: what was noted before stands again.

    Raises:
        OtherRun: an unfinished run there has another configuration, other flights or other versions.
        ValueError: what is there cannot be read, or flights that are asked for.
    """
    record = describe(config)
    if config.fresh:
        _move_aside(folder, say)
    found = read_json(folder / FILE) if (folder / FILE).exists() else {}
    goes_on = found.get("state") == "unfinished"
    if goes_on:
        require_same(f"{folder}: holds an unfinished run, begun {found['started']}", found, record)
        record["started"] = found["started"]
        say(f"{folder}: goes on with the run begun {found['started']}")
    _write(folder, record, "unfinished")
    try:
        yield
    except ValueError:
        if found:
            write_atomic(folder / FILE, json_text(found))
        else:
            (folder / FILE).unlink()
        raise
    _write(folder, record, "finished")


def describe(config: Run) -> dict[str, Any]:
    """All that fixes the results, as JSON values, and the time [UTC, ISO 8601]."""
    options = config.described()
    given = {name: value for name, value in options.items() if isinstance(value, Path)}
    return {
        "config": json_value({name: value for name, value in options.items() if name not in given}),
        "versions": versions(*PACKAGES),
        "flights": {name: _sha256(path) for name, path in given.items()},
        "started": datetime.now(UTC).isoformat(timespec="seconds"),
    }


def require_same(what: str, old: Mapping[str, Any], new: Mapping[str, Any]) -> None:
    """Compare what fixes a run.

    Raises:
        OtherRun: it differs; names `what`, and a line for each field with old → new.
    """
    before, now = (_flat({name: each.get(name, {}) for name in FIXED}) for each in (old, new))
    lines = [
        f"  {name}: {before.get(name, 'absent')} → {now.get(name, 'absent')}"
        for name in sorted(before.keys() | now.keys())
        if before.get(name) != now.get(name)
    ]
    if lines:
        raise OtherRun("\n".join([f"{what}, that differs:", *lines, f"  {ANEW}; another --out leaves it as it is"]))


def _write(folder: Path, record: Mapping[str, Any], state: str) -> None:
    write_atomic(folder / FILE, json_text({**record, "state": state}))


def _move_aside(folder: Path, say: Callable[[str], None]) -> None:
    """Move all that a run has left into a neighbour, its record last: a kill in between loses nothing."""
    left = [path for path in folder.iterdir() if path.name != ".lock"]
    if left:
        elsewhere = backup_path(folder, "before")
        elsewhere.mkdir()
        for path in sorted(left, key=lambda path: path.name == FILE):
            path.rename(elsewhere / path.name)
        say(f"{folder}: what was there is now in {elsewhere}")


def _sha256(path: Path) -> str:
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise ValueError(f"{path}: cannot be read: {error.strerror}") from error


def _flat(tree: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for name, value in tree.items():
        flat |= _flat(value, f"{prefix}{name}.") if isinstance(value, Mapping) else {f"{prefix}{name}": value}
    return flat
