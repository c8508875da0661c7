"""Checkpoints of an unfinished sweep: numbered archives, saved between blocks of epochs; signals wait for them."""

import signal
import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any, Self

import numpy as np

from experiments.runner.run_record import PACKAGES, backup_path
from hybrid_jax.io.datasets import versions
from hybrid_jax.io.files import Arrays, load_archive, named_leaves, save_archive
from hybrid_jax.sweep import hosts
from hybrid_jax.training.fitting import FitState

FORMAT = "hybrid_jax checkpoint 1"
KEPT = 2
FIRST_COST = 0.05  # s to save a checkpoint, before it is measured


class Checkpoints:
    """The last two checkpoints of one sweep, in a folder of its own."""

    def __init__(self, folder: Path):
        self._folder = folder

    def save(self, about: Any, arrays: Arrays) -> None:
        """Write the next checkpoint (`about`: JSON values), then delete all but the last two; OSError if it fails."""
        paths = self._paths()
        number = 1 + max((int(path.stem) for path in paths), default=0)
        save_archive(self._folder / f"{number:06d}.npz", FORMAT, about, arrays)
        for path in paths[: 1 - KEPT]:
            path.unlink()

    def load(self, say: Callable[[str], None]) -> tuple[Any, dict[str, np.ndarray]] | None:
        """Return the newest intact checkpoint, if any; rename a damaged one with a line to `say`."""
        for path in reversed(self._paths()):
            try:
                return load_archive(path, FORMAT)
            except ValueError as error:
                say(f"{error}; renamed to {path.rename(backup_path(path, 'damaged')).name}")
        return None

    def delete(self) -> None:
        """Delete all checkpoints, once the finished sweep is saved elsewhere; renamed files stay."""
        for path in (*self._paths(), *self._folder.glob(".*.part")):
            path.unlink()
        if self._folder.exists() and not any(self._folder.iterdir()):
            self._folder.rmdir()

    def _paths(self) -> list[Path]:
        return sorted(path for path in self._folder.glob("*.npz") if path.stem.isdecimal())


class DeferredSignals(AbstractContextManager):
    """Defer the first SIGINT, SIGTERM or SIGHUP to `raise_pending` or the end of the context; a second acts at once.

    Only signals with a Python handler are deferred, and only in the main thread.
    """

    def __init__(self):
        self.pending: int | None = None  # the signal that has arrived
        self._before: dict[int, Any] = {}

    def __enter__(self) -> Self:
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            if callable(handler := signal.getsignal(number)):
                self._before[number] = handler
                signal.signal(number, self._note)
        return self

    def __exit__(self, kind, error, trace) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)
        if kind is None:
            self.raise_pending()

    def raise_pending(self) -> None:
        """Call the original handler of a signal that has arrived; the handler raises."""
        number, self.pending = self.pending, None
        if number is not None:
            self._before[number](number, None)

    def _note(self, number: int, frame) -> None:
        again, self.pending = self.pending is not None, number
        if again:
            self.raise_pending()


class Autosave:
    """Save a sweep between blocks, within its share of the time, and whenever a signal is pending.

    `spent`: seconds of earlier runs.
    """

    def __init__(self, checkpoints: Checkpoints, signals: DeferredSignals, name: str, spent: float, share: float):
        self._checkpoints, self._signals, self._name = checkpoints, signals, name
        self._spent, self._share = spent, share
        self._began, self._cost = time.perf_counter(), FIRST_COST
        self._unsaved: FitState | None = None
        self.saving = 0.0  # s spent on saving

    def seconds(self) -> float:
        """Time spent on the sweep so far, including earlier runs."""
        return self._spent + time.perf_counter() - self._began

    def after_block(self, states: FitState) -> None:
        """Save the states if it is time to, then let a pending signal act."""
        self._unsaved = states
        due = self.saving + self._cost < self._share * (self.seconds() - self._spent)
        if due or self._signals.pending is not None:
            self.save_last_block()
        self._signals.raise_pending()

    def save_last_block(self) -> None:
        """Save the last block, unless it is already saved."""
        if self._unsaved is None or not hosts.is_main_process():
            return
        began = time.perf_counter()
        about = {"name": self._name, "seconds": self.seconds(), "versions": versions(*PACKAGES)}
        self._checkpoints.save(about, named_leaves(self._unsaved))
        self._cost = time.perf_counter() - began
        self.saving += self._cost
        self._unsaved = None
