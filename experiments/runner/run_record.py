"""A run's environment, and run.json with its configuration, so that only the same run can resume."""

import hashlib
import itertools
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from experiments.reporting.results import Results, leaves
from experiments.runner.options import Run
from hybrid_jax import kernels
from hybrid_jax.checks import content_of, first_line
from hybrid_jax.cli.command import ChecksFailed, Explained
from hybrid_jax.io.datasets import versions
from hybrid_jax.io.files import json_text, json_value, write_atomic
from hybrid_jax.runtime import cores, hardware

PACKAGES = ("jax", "jaxlib", "equinox", "diffrax", "optax", "mujoco", "mujoco-mjx", "numpy", "hybrid_jax")
FILE = "run.json"
HINT = "  --restart starts from the beginning and renames it; another --out leaves it unchanged"
FIXED = ("config", "versions", "flights")  # a run resumes only if these are equal
MACHINE = ("machine",)  # where these are not, it says so


def environment(stages: Mapping[str, float]) -> dict[str, Any]:
    """Return versions, hardware, seconds of each stage and the date (UTC, ISO 8601), as JSON values."""
    return {
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "versions": versions(*PACKAGES),
        "hardware": hardware(),
        "seconds": {stage: round(float(seconds), 3) for stage, seconds in stages.items()},
    }


def record_of(
    experiment: str, config: Run, rows: Results, seconds: Mapping[str, float], notes: Sequence[str] = (), **more: Any
) -> dict[str, Any]:
    """Return all that a report is made of, as JSON values: what report.json keeps, but verdicts and captions."""
    record = {"experiment": experiment, "config": config.described(), "environment": environment(seconds)}
    return json_value(record | {"tags": rows.tags, "rows": rows.rows, "notes": notes, **more})


class OtherRun(Explained):
    """The unfinished run differs from the requested one; the message has one line per difference."""


@contextmanager
def recorded(folder: Path, config: Run, say: Callable[[str], None]) -> Iterator[None]:
    """Record the beginning and the end of a run in a folder; bad input and failed checks restore the previous record.

    Raises:
        OtherRun: an unfinished run there has another configuration, other flights or other versions.
        ValueError: the record or a given file of flights cannot be read.
    """
    path, record = folder / FILE, describe(config)
    if config.fresh:
        _move_aside(folder, say)
    known = path.exists()
    found: dict[str, Any] = record_in(path) if known else {"state": None}
    if found["state"] == "unfinished":
        begun = f"{folder}: holds an unfinished run, begun {found['started']}"
        if (kernels_then := found["machine"]["kernels"]) != "used":  # nor are they now, whatever the reason
            kernels.switch_off()
            record["machine"]["kernels"] = kernels_then
        require_same(begun, found, record)
        if kernels_then != record["machine"]["kernels"]:  # rows of one run have the same rounding
            raise OtherRun(f"{begun} with kernels, which are now {record['machine']['kernels']}\n{HINT}")
        say(f"{folder}: goes on with the run begun {found['started']}")
        for line in _differences(found, record, MACHINE):
            say(f"{line.strip()}: rows differ, if little, from those of a run on one machine")
        record |= {name: found[name] for name in ("started", *MACHINE) if name in found}
    write_atomic(path, json_text(record | {"state": "unfinished"}))
    try:
        yield
    except (ValueError, ChecksFailed):
        if known:
            write_atomic(path, json_text(found))
        else:
            path.unlink()
        raise
    write_atomic(path, json_text(record | {"state": "finished"}))


def record_in(path: Path) -> dict[str, Any]:
    """Return a run's record; ValueError of one line for any other file."""
    try:
        found = json.loads(content_of(path))
    except (OSError, ValueError, RecursionError) as error:
        raise ValueError(f"{path}: truncated or not JSON: {first_line(error)}") from error
    if not (isinstance(found, dict) and {"state", "started", *FIXED, *MACHINE} <= found.keys()):
        raise ValueError(f"{path}: not the record of a run; --restart starts from the beginning and renames it")
    return found


def describe(config: Run) -> dict[str, Any]:
    """Return all inputs of the results, as JSON values, and the time [UTC, ISO 8601]."""
    options = config.described()
    given = {name: value for name, value in options.items() if isinstance(value, Path)}
    return {
        "config": json_value({name: value for name, value in options.items() if name not in given}),
        "versions": versions(*PACKAGES),
        "flights": {name: _sha256(path) for name, path in given.items()},
        "machine": {"cores": cores(), "kernels": kernels.status().partition("\n")[0]},
        "started": datetime.now(UTC).isoformat(timespec="seconds"),
    }


def require_same(what: str, old: Mapping[str, Any], new: Mapping[str, Any]) -> None:
    if lines := _differences(old, new, FIXED):
        raise OtherRun("\n".join([f"{what}, that differs:", *lines, HINT]))


def _differences(old: Mapping[str, Any], new: Mapping[str, Any], parts: tuple[str, ...]) -> list[str]:
    before, now = (dict(leaves({name: each.get(name) or {} for name in parts}, ".")) for each in (old, new))
    return [
        f"  {name}: {before.get(name, 'absent')} → {now.get(name, 'absent')}"
        for name in sorted(before.keys() | now.keys())
        if before.get(name) != now.get(name)
    ]


def backup_path(path: Path, reason: str) -> Path:
    """Return an unused name beside a path with the reason and the time (UTC), to rename it instead of deleting it."""
    stem = f"{path.name}.{reason}-{datetime.now(UTC):%Y%m%dT%H%M%SZ}"
    names = itertools.chain([stem], (f"{stem}-{i}" for i in itertools.count(2)))
    return next(free for free in map(path.with_name, names) if not free.exists())


def _move_aside(folder: Path, say: Callable[[str], None]) -> None:
    """Move a results folder's contents to a backup beside it, the record last, so that a kill loses nothing."""
    left = [path for path in folder.iterdir() if path.name != ".lock"]
    if left:
        elsewhere = backup_path(folder, "before")
        elsewhere.mkdir()
        for path in sorted(left, key=lambda path: path.name == FILE):
            path.rename(elsewhere / path.name)
        say(f"{folder}: earlier contents moved to {elsewhere}")


def _sha256(path: Path) -> str:
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise ValueError(f"{path}: cannot be read: {error.strerror}") from error
