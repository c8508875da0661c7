"""Progress on stderr: a live line in a terminal, an occasional plain line in a file."""

import threading
import time
from contextlib import AbstractContextManager
from typing import Self

from rich.console import Console
from rich.live import Live
from rich.text import Text

from hybrid_jax.sweep.training import Progress

FIRST, SECOND, INTERVAL = 1.0, 5.0, 30.0  # s before the first and the second line in a file, and between later ones


class Line(AbstractContextManager):
    """One line about a stage: the current work, the elapsed time and, if known, the remaining time.

    A terminal shows it at once, with a running clock. A file gets it after a second, so that short stages add no line.
    """

    def __init__(self, name: str, console: Console, doing: str = "compiling"):
        self._name, self._console, self._doing, self._began = name, console, doing, time.perf_counter()
        self._due = self._began + SECOND
        self._live = self._timer = None
        if console.is_terminal:
            self._live = Live(self, console=console, transient=True)
        else:
            self._timer = threading.Timer(FIRST, self._print)
            self._timer.daemon = True

    def __rich__(self) -> Text:
        return Text(f"{self}, {clock(self._elapsed())} elapsed", no_wrap=True, overflow="ellipsis")

    def __str__(self) -> str:
        return f"{self._name}: {self._doing}"

    def __enter__(self) -> Self:
        if self._live is not None:
            self._live.start(refresh=True)
        if self._timer is not None:
            self._timer.start()
        return self

    def __exit__(self, *exception) -> None:
        if self._timer is not None:
            self._timer.cancel()
        if self._live is not None:
            self._live.stop()

    def say(self, doing: str) -> None:
        """Show the current work; in a file at most once per INTERVAL."""
        self._doing = doing
        if self._live is None and time.perf_counter() > self._due:
            self._due = time.perf_counter() + INTERVAL
            self._print()

    def show_share(self, doing: str, share: float) -> None:
        left = f", {clock(self._elapsed() * (1 - share) / share)} left" if share > 0 else ""
        self.say(f"{doing} {share:.0%}{left}")

    def show_parts(self, done: int, parts: int) -> None:
        self.show_share(f"{done} of {parts} parts,", done / parts)

    def show_sweep(self, progress: Progress) -> None:
        share = progress.active / progress.lanes  # stopped runs cost nothing
        epoch = share * progress.seconds / max(progress.epochs, 1)
        self.say(
            f"training {progress.active} of {progress.lanes} runs, epoch {progress.epochs}, best validation loss "
            f"{progress.best:.3g}, {clock(epoch * progress.at_least)} to {clock(epoch * progress.at_most)} left"
        )

    def _elapsed(self) -> float:
        return time.perf_counter() - self._began

    def _print(self) -> None:
        elapsed = f", {clock(self._elapsed())} elapsed" if self._elapsed() >= SECOND else ""
        self._console.print(f"{self}{elapsed}", highlight=False, soft_wrap=True)


def clock(seconds: float) -> str:
    return f"{int(seconds) // 60}:{int(seconds) % 60:02d}"
