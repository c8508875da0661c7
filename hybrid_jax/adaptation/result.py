"""The result of `adapt`: one type for all methods."""

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from hybrid_jax.dynamics.base import AbstractVectorField
from hybrid_jax.training.fitting import CAPPED, DIVERGED, STOPPED

STATUS = {STOPPED: "converged", CAPPED: "stopped at the limit of steps", DIVERGED: "diverged"}
NOT_LEAST_SQUARES = "they are valid for least squares only, where no network is trained on the same windows"
UNDETERMINED = "the windows do not determine the parameters"


@dataclass(frozen=True)
class Parameter:
    """A physical parameter and its confidence interval; low and high are None where there is no valid one."""

    value: float
    low: float | None = None
    high: float | None = None
    unit: str | None = None

    def __str__(self) -> str:
        around = "" if self.low is None or self.high is None else f"  ({self.low:.4g} to {self.high:.4g})"
        return f"{self.value:.4g}{f' {self.unit}' if self.unit else ''}{around}"


@dataclass(frozen=True, eq=False)
class Adaptation:
    """An adapted field and what is known about it.

    Attributes:
        method: the name, or the class of a method that was passed as a value.
        parameters: of physics and disturbance, by name; see `uncertainty.named_parameters`.
        disturbance: the constant part of ẋ, one number for each state, if there is one.
        mse_before, mse_after: L_MSE of source and adapted field on all windows.
        windows: their number.
        steps: epochs, or evaluations of the Jacobian; 0 for a closed form.
        status: one of `STATUS`.
        level: confidence level of the intervals.
        without_intervals: why there are none, if so.
    """

    field: AbstractVectorField
    method: str
    parameters: dict[str, Parameter]
    disturbance: Float[np.ndarray, " d"] | None
    mse_before: float
    mse_after: float
    windows: int
    steps: int
    status: str
    level: float
    without_intervals: str | None

    @property
    def converged(self) -> bool:
        """Whether the method stopped by itself, at a finite error."""
        return self.status == STATUS[STOPPED]

    def report(self) -> str:
        """A summary in plain text, a few lines."""
        after = f" after {self.steps} steps" if self.steps else ""
        lines = [
            f"Adapted to {self.windows} windows by {self.method}: {self.status}{after}.",
            f"Mean squared prediction error: {self.mse_before:.3g} before, {self.mse_after:.3g} after.",
        ]
        if self.parameters:
            note = f"{self.level:.0%} confidence intervals" if self.without_intervals is None else "no intervals"
            width = max(map(len, self.parameters))
            lines.append(f"Parameters ({note}):")
            lines += [f"  {name:<{width}}  {parameter}" for name, parameter in self.parameters.items()]
        lines.append(f"Constant disturbance: {'none' if self.disturbance is None else 'see parameters'}.")
        if self.parameters and self.without_intervals is not None:
            lines.append(f"No intervals: {self.without_intervals}.")
        return "\n".join(lines)

    def to_dict(self) -> dict[str, Any]:
        """Everything but the field, as JSON values."""
        kept = {name: value for name, value in vars(self).items() if name not in ("field", "parameters", "disturbance")}
        disturbance = None if self.disturbance is None else self.disturbance.tolist()
        parameters = {name: asdict(parameter) for name, parameter in self.parameters.items()}
        return kept | {"converged": self.converged, "disturbance": disturbance, "parameters": parameters}
