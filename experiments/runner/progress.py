"""Progress on stderr: a live line in a terminal, an occasional plain line in a file."""

import time
from contextlib import AbstractContextManager
from typing import Self

from rich.console import Console
from rich.live import Live
from rich.text import Text

from hybrid_jax.sweep.training import Progress

FIRST, INTERVAL = 5.0, 30.0  # s before the first line in a file, and between lines


class Line(AbstractContextManager):
    """One line about a stage, updated by `say`."""

    def __init__(self, name: str, console: Console):
        self._name, self._console = name, console
        self._live = Live(Text(f"{name}: compiling"), console=console, transient=True) if console.is_terminal else None
        self._due = time.perf_counter() + FIRST

    def __enter__(self) -> Self:
        if self._live is not None:
            self._live.start()
        return self

    def __exit__(self, *exception) -> None:
        if self._live is not None:
            self._live.stop()

    def say(self, text: str) -> None:
        """Show the text; in a file at most once per INTERVAL."""
        line = f"{self._name}: {text}"
        if self._live is not None:
            self._live.update(Text(line))
        elif time.perf_counter() > self._due:
            self._due = time.perf_counter() + INTERVAL
            self._console.print(line, highlight=False, soft_wrap=True)


class SweepLine(Line):
    """The progress of a sweep."""

    def show(self, progress: Progress) -> None:
        """Show the progress; called after each block."""
        self.say(describe(progress))


class PartLine(Line):
    """The progress of work in a known number of parts."""

    def __init__(self, name: str, console: Console, parts: int):
        super().__init__(name, console)
        self._parts, self._began = parts, time.perf_counter()

    def show(self, done: int) -> None:
        """Show the number of finished parts and the time left, if the others take as long."""
        elapsed = time.perf_counter() - self._began
        left = elapsed / done * (self._parts - done)
        self.say(f"{done} of {self._parts} parts, {clock(elapsed)} elapsed, {clock(left)} left")


def describe(progress: Progress) -> str:
    """Active runs, best loss, elapsed time, and bounds of the time left."""
    low, high = (progress.seconds * left / max(progress.epochs, 1) for left in (progress.at_least, progress.at_most))
    share = progress.active / progress.lanes  # stopped runs cost nothing
    return (
        f"{progress.active} of {progress.lanes} runs active, epoch {progress.epochs}, best validation loss "
        f"{progress.best:.3g}, {clock(progress.seconds)} elapsed, {clock(low * share)} to {clock(high * share)} left"
    )


def clock(seconds: float) -> str:
    """Minutes and seconds."""
    return f"{int(seconds) // 60}:{int(seconds) % 60:02d}"
