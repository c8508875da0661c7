"""What is chosen among models and recipes, see `hybrid_jax.cli.choice`, and what was known when it was."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float

from hybrid_jax.cli.choice import Scores


@dataclass(frozen=True)
class Candidate:
    """A model and the recipe that trains it; a baseline, without a recipe; or the mean of the fields of some parts."""

    model: str
    recipe: str = ""
    parts: tuple["Candidate", ...] = ()

    @classmethod
    def blend(cls, parts: Sequence["Candidate"]) -> "Candidate":
        return cls("", parts[0].recipe, tuple(parts))

    def __str__(self) -> str:
        return " + ".join(map(str, self.parts)) if self.parts else f"{self.model} {self.recipe}".rstrip()


@dataclass(frozen=True)
class Selection:
    """The choice in one fold, for one N."""

    fold: str
    n_train: int
    chosen: Candidate
    left_out: Sequence[str]  # flights or manoeuvres
    scores: Scores[Candidate]
    expected: Float[np.ndarray, "3 labels quantities"]  # of the chosen candidate, and the ends of the interval
    labels: Sequence[str] = ()
    observed: dict[str, np.ndarray] = field(default_factory=dict)  # its errors on each test flight, where there are any

    def inside(self) -> Float[np.ndarray, "labels quantities"]:
        """The number of test flights whose error lies in its interval."""
        _, low, high = self.expected
        return np.sum([(low <= each) & (each <= high) for each in self.observed.values()], axis=0)

    def described(self) -> dict[str, Any]:
        """As JSON values."""
        flights = self.left_out
        scores = {str(name): dict(zip(flights, each.mean(axis=1), strict=True)) for name, each in self.scores.items()}
        return vars(self) | {
            "chosen": str(self.chosen),
            "scores": scores,
            "expected": dict(zip(("value", "low", "high"), self.expected, strict=True)),
        }
