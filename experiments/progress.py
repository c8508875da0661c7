"""Progress on stderr: a live line for a person, a plain line now and then where the output is a file."""

import time
from contextlib import AbstractContextManager

from rich.console import Console
from rich.live import Live
from rich.text import Text

from hybrid_jax.sweep import Progress

FIRST, QUIET = 5.0, 30.0  # s before the first line in a file, and between two


class SweepLine(AbstractContextManager):
    """One line about a sweep; `show` is what `sweep` calls after each block."""

    def __init__(self, name: str, console: Console):
        self._name, self._console = name, console
        self._live = Live(Text(f"{name}: compiling"), console=console, transient=True) if console.is_terminal else None
        self._due = time.perf_counter() + FIRST

    def __enter__(self) -> "SweepLine":
        if self._live is not None:
            self._live.start()
        return self

    def __exit__(self, *exception) -> None:
        if self._live is not None:
            self._live.stop()

    def show(self, progress: Progress) -> None:
        """Draw where the sweep is."""
        line = f"{self._name}: {describe(progress)}"
        if self._live is not None:
            self._live.update(Text(line))
        elif time.perf_counter() > self._due:
            self._due = time.perf_counter() + QUIET
            self._console.print(line, highlight=False, soft_wrap=True)


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
