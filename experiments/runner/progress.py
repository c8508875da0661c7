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
        self._name, self._console, self._began = name, console, time.perf_counter()
        self._live = Live(Text(f"{name}: compiling"), console=console, transient=True) if console.is_terminal else None
        self._due = self._began + FIRST

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

    def show_parts(self, done: int, parts: int) -> None:
        """Show the number of finished parts and the time left, if the others take as long."""
        elapsed = time.perf_counter() - self._began
        left = elapsed / done * (parts - done)
        self.say(f"{done} of {parts} parts, {clock(elapsed)} elapsed, {clock(left)} left")

    def show_sweep(self, progress: Progress) -> None:
        """Show active runs, best loss, elapsed time, and bounds of the time left."""
        share = progress.active / progress.lanes  # stopped runs cost nothing
        epoch = share * progress.seconds / max(progress.epochs, 1)
        self.say(
            f"{progress.active} of {progress.lanes} runs active, epoch {progress.epochs}, best validation loss "
            f"{progress.best:.3g}, {clock(progress.seconds)} elapsed, "
            f"{clock(epoch * progress.at_least)} to {clock(epoch * progress.at_most)} left"
        )


def clock(seconds: float) -> str:
    return f"{int(seconds) // 60}:{int(seconds) % 60:02d}"
