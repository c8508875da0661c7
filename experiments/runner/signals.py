"""Defer SIGINT and SIGTERM until a block of epochs is complete."""

import signal
from contextlib import AbstractContextManager
from typing import Any, Self


class DeferredSignals(AbstractContextManager):
    """Defer the first signal until `raise_pending` or the end of the context; a second one acts at once.

    Only signals with a Python handler are deferred, and only in the main thread.
    """

    def __init__(self):
        self._first: int | None = None
        self._before: dict[int, Any] = {}

    def __enter__(self) -> Self:
        for number in (signal.SIGINT, signal.SIGTERM):
            if callable(handler := signal.getsignal(number)):
                self._before[number] = handler
                signal.signal(number, self._note)
        return self

    def __exit__(self, kind, error, trace) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)
        if kind is None:
            self.raise_pending()

    @property
    def pending(self) -> bool:
        """Whether a signal has arrived."""
        return self._first is not None

    def raise_pending(self) -> None:
        """Call the original handler of a signal that has arrived; the handler raises."""
        number, self._first = self._first, None
        if number is not None:
            self._before[number](number, None)

    def _note(self, number: int, frame) -> None:
        again, self._first = self.pending, number
        if again:
            self.raise_pending()
