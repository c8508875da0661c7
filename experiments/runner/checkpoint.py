"""The state of a sweep that is going on: numbered checkpoints, written by orbax whole or not at all, and checked."""

import logging
import shutil
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any

import jax
import numpy as np
import orbax.checkpoint as ocp
from orbax.checkpoint._src.futures import signaling_client

from hybrid_jax.io.archive import Arrays, digest
from hybrid_jax.io.files import backup_path

KEPT = 2
PARTIAL = ".orbax-checkpoint-tmp"  # orbax writes under a name that ends so, then renames


class Checkpoints:
    """Checkpoints of one sweep in a folder of their own; the last two are kept.

    Args:
        folder: made when the first is saved.
    """

    def __init__(self, folder: Path):
        self._folder = folder.absolute()  # orbax takes no other
        self._orbax = _orbax()

    def save(self, arrays: Arrays, about: Any) -> None:
        """Write the next checkpoint, then delete those before the last two.

        Args:
            arrays: none empty, which orbax would refuse.
            about: JSON values.

        Raises:
            OSError: it cannot be written, as on a full disk; one line, and the checkpoints before it are as they were.
        """
        numbers = self._numbers()
        path = self._path(numbers[-1] + 1 if numbers else 1)
        content = ocp.args.Composite(
            arrays=ocp.args.StandardSave(dict(arrays)),
            about=ocp.args.JsonSave({"sha256": digest(about, arrays), "about": about}),
        )
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            self._sweep_up()
            with _quietly():
                self._orbax.save(path, args=content)
        except Exception as error:  # orbax and its storage raise a full disk as errors of many kinds
            self._sweep_up()
            raise OSError(
                f"{path}: the state cannot be saved: {_cause(error)}; what was saved before is intact"
            ) from error
        for number in numbers[: 1 - KEPT]:
            shutil.rmtree(self._path(number), ignore_errors=True)

    def load(self, say: Callable[[str], None]) -> tuple[dict[str, np.ndarray], Any] | None:
        """Arrays and what is said about them, from the newest checkpoint that is whole; None if there is none.

        Args:
            say: told in a line of each that is truncated or damaged; it is renamed, not deleted.
        """
        for number in reversed(self._numbers()):
            path = self._path(number)
            try:
                return self._read(path)
            except Exception as error:  # a damaged byte can make orbax and its storage raise anything
                renamed = path.rename(backup_path(path, "damaged"))
                say(f"{path}: truncated or damaged, set aside as {renamed.name}: {_cause(error)}")
        return None

    def delete(self) -> None:
        """Delete all that was saved, when the sweep is finished and kept elsewhere; not what was set aside."""
        for number in self._numbers():
            shutil.rmtree(self._path(number))
        self._sweep_up()
        if self._folder.exists() and not any(self._folder.iterdir()):
            self._folder.rmdir()

    def _read(self, path: Path) -> tuple[dict[str, np.ndarray], Any]:
        wanted = ocp.args.Composite(arrays=ocp.args.StandardRestore(), about=ocp.args.JsonRestore())
        with _quietly():
            found = self._orbax.restore(path, args=wanted)
        arrays = {name: np.asarray(array) for name, array in found.arrays.items()}
        if found.about["sha256"] != digest(found.about["about"], arrays):
            raise ValueError("checksum differs from the one recorded")
        return arrays, found.about["about"]

    def _numbers(self) -> list[int]:
        return sorted(int(path.name) for path in self._folder.glob("*") if path.name.isdecimal())

    def _path(self, number: int) -> Path:
        return self._folder / f"{number:06d}"

    def _sweep_up(self) -> None:
        """Delete what a kill, or a save that failed, left half written."""
        for path in self._folder.glob(f"*{PARTIAL}*"):
            shutil.rmtree(path, ignore_errors=True)


@cache
def _expect_late_futures() -> None:
    """Say nothing of what else ends in the same error after orbax has raised the first; nothing else here is async."""
    otherwise = sys.unraisablehook

    def hook(late) -> None:
        if not (isinstance(late.exc_value, RuntimeError) and str(late.exc_value) == "Event loop is closed"):
            otherwise(late)

    sys.unraisablehook = hook
    asyncio_log = logging.getLogger("asyncio")
    asyncio_log.addFilter(lambda record: not record.getMessage().startswith("Task exception was never retrieved"))


@cache
def _signal_here() -> None:
    """Let orbax's threads signal each other within this process.

    It would do so through JAX's coordination service as soon as there are several processes, but `hosts.join` has shut
    that down, and each process that saves here saves alone. Orbax has no option for it.
    """
    client = signaling_client.ThreadSafeKeyValueSignalingClient()
    signaling_client.get_signaling_client = lambda: client


def _orbax() -> ocp.Checkpointer:
    _expect_late_futures()
    if jax.process_count() > 1:
        _signal_here()
    here = jax.process_index()  # of several hosts, each that saves does so alone, and waits for no other
    alone = ocp.options.MultiprocessingOptions(
        primary_host=here, active_processes={here}, barrier_sync_key_prefix=f"process{here}"
    )
    handler = ocp.CompositeCheckpointHandler(
        arrays=ocp.StandardCheckpointHandler(multiprocessing_options=alone),
        about=ocp.JsonCheckpointHandler(multiprocessing_options=alone),
        composite_options=ocp.CompositeOptions(multiprocessing_options=alone),
    )
    return ocp.Checkpointer(handler, multiprocessing_options=alone)


@contextmanager
def _quietly() -> Iterator[None]:
    """Without the traces that threads of orbax log of an error before they raise it."""
    logger = logging.getLogger("absl")
    level = logger.level
    logger.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        logger.setLevel(level)


def _cause(error: Exception) -> str:
    """The end of an error of orbax's storage, which goes from the general to the particular; one line."""
    if isinstance(error, OSError) and error.strerror:
        return error.strerror
    lines = str(error).splitlines() or [type(error).__name__]
    return lines[0].rsplit(": ", 1)[-1]
