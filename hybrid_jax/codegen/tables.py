"""Tables, functions and names that the functions of one file share."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from hybrid_jax.codegen.nodes import Function, Parameter, Statement


@dataclass
class Tables:
    """Tables of numbers, called functions, and unused names.

    Attributes:
        double: whether numbers are in double instead of single precision.
        numbers: tables by name.
        functions: functions, each after the functions that it calls.
    """

    double: bool
    numbers: dict[str, np.ndarray] = field(default_factory=dict)
    functions: list[Function] = field(default_factory=list)
    _known: dict[bytes, str] = field(default_factory=dict)  # bytes of the numbers → name
    _count: int = 0

    def name(self, letter: str) -> str:
        self._count += 1
        return f"{letter}{self._count}"

    def function(self, parameters: Sequence[Parameter], body: tuple[Statement, ...]) -> str:
        """Add a function and return its name."""
        self.functions.append(Function(self.name("f"), tuple(parameters), body))
        return self.functions[-1].name

    def table(self, numbers: np.ndarray) -> str:
        """Add a table, or reuse an equal one, and return its name."""
        numbers = np.asarray(numbers, float if self.double else np.float32)
        name = self._known.setdefault(numbers.tobytes(), f"c{len(self._known)}")
        self.numbers[name] = numbers
        return name
