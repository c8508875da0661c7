"""How a fit ended: one enumeration for all iterative methods."""

from enum import IntEnum


class Status(IntEnum):
    """How a fit ended. Compiled programs return it as an integer, which `Status(int(number))` converts.

    Attributes:
        message: a description in words.
    """

    RUNNING = 0, "interrupted"
    OK = 1, "converged"
    CAPPED = 2, "stopped at the limit of steps"
    DIVERGED = 3, "diverged"
    STALLED = 4, "found no step that lowers the error"

    message: str

    def __new__(cls, value: int, message: str):
        status = int.__new__(cls, value)
        status._value_, status.message = value, message
        return status

    def __str__(self) -> str:
        return self.name.lower()

    def __format__(self, form: str) -> str:
        return format(str(self), form)
