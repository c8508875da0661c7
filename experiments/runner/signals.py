"""SIGINT and SIGTERM, held back while a sweep is in a block of epochs."""

import signal
from contextlib import AbstractContextManager
from typing import Any


class Held(AbstractContextManager):
    """Hold the first signal until `deliver`, or until the end; a second one acts at once.

    Only signals that the process handles in Python are held, and only in its main thread, as Python has it.
    """

    def __init__(self):
        self._first: int | None = None
        self._before: dict[int, Any] = {}

    def __enter__(self) -> "Held":
        handlers = {int(number): signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
        self._before = {number: handler for number, handler in handlers.items() if callable(handler)}
        for number in self._before:
            signal.signal(number, self._note)
        return self

    def __exit__(self, kind, error, trace) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)
        if kind is None:
            self.deliver()

    @property
    def waiting(self) -> bool:
        """Whether a signal has come."""
        return self._first is not None

    def deliver(self) -> None:
        """Let a signal that has come act now: its handler raises."""
        if self._first is not None:
            self._act(self._first)

    def _note(self, number: int, frame) -> None:
        if self._first is not None:
            self._act(number)
        self._first = number

    def _act(self, number: int) -> None:
        self._first = None
        self._before[number](number, None)
