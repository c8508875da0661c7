"""Progress on stderr: a live line for a person, a plain line now and then where the output is a file."""

import time
from contextlib import AbstractContextManager
from typing import Self

from rich.console import Console
from rich.live import Live
from rich.text import Text

from hybrid_jax.sweep.training import Progress

FIRST, QUIET = 5.0, 30.0  # s before the first line in a file, and between two


class Line(AbstractContextManager):
    """One line about a stage, drawn anew whenever there is news."""

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

    def say(self, news: str) -> None:
        """Draw the news, in a file only now and then."""
        line = f"{self._name}: {news}"
        if self._live is not None:
            self._live.update(Text(line))
        elif time.perf_counter() > self._due:
            self._due = time.perf_counter() + QUIET
            self._console.print(line, highlight=False, soft_wrap=True)


class SweepLine(Line):
    """About a sweep; `show` is what `sweep` calls after each block."""

    def show(self, progress: Progress) -> None:
        """Draw where the sweep is."""
        self.say(describe(progress))


class PartLine(Line):
    """About work in so many parts, of which `show` is told how many are done."""

    def __init__(self, name: str, console: Console, parts: int):
        super().__init__(name, console)
        self._parts, self._began = parts, time.perf_counter()

    def show(self, done: int) -> None:
        """Draw how many parts are done, and what is left if the others take as long."""
        gone = time.perf_counter() - self._began
        left = gone / done * (self._parts - done)
        self.say(f"{done} of {self._parts} parts, {clock(gone)} gone, {clock(left)} left")


def describe(progress: Progress) -> str:
    """Lanes active, best loss, time gone and an estimate of what is left: least and most epochs to come."""
    low, high = (progress.seconds * left / max(progress.epochs, 1) for left in (progress.at_least, progress.at_most))
    share = progress.active / progress.lanes  # stopped lanes cost nothing any more
    return (
        f"{progress.active} of {progress.lanes} lanes active, epoch {progress.epochs}, best validation loss "
        f"{progress.best:.3g}, {clock(progress.seconds)} gone, {clock(low * share)} to {clock(high * share)} left"
    )


def clock(seconds: float) -> str:
    """Minutes and seconds."""
    return f"{int(seconds) // 60}:{int(seconds) % 60:02d}"
