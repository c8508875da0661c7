"""Options and presets."""

from dataclasses import dataclass, replace
from typing import Literal, get_args

from experiments.runner.options import Count, Run, distinct

Part = Literal["forecast", "shifted", "gray_scott"]
CaseName = Literal[
    "pointwise",
    "pointwise, noise 0.001",
    "pointwise, noise 0.01",
    "convolution",
    "convolution, least action",
    "convolution, correlation (paper)",
    "convolution, neighbours penalised",
    "no physics, convolution",
    "physics alone: diffusion",
    "physics alone: complete",
]
Shift = Literal["parameter_shift", "new_term"]


@dataclass(frozen=True)
class Config(Run):
    """Learn and adapt reaction-diffusion equations."""

    seeds: Count = 10
    """Trials: initial weights and training trajectories. Forecasts take three at most: the tables say how many."""
    parts: tuple[Part, ...] = get_args(Part)
    """forecast: as APHYNITY. shifted: adapt to changed equations. gray_scott: as Neural Context Flows."""
    cases: tuple[CaseName, ...] = get_args(CaseName)
    """Lines of the table of forecasts."""
    shifts: tuple[Shift, ...] = get_args(Shift)
    """parameter_shift: a × 2, b ÷ 2, k × 2. new_term: u_t has a term that the source never had."""
    sizes: tuple[Count, ...] = (1, 2, 4, 8)
    """Trajectories to adapt to."""
    points: Count = 32
    """Grid points along each axis."""
    test: Count = 100
    """Test trajectories of forecasts; after a shift, and of Gray–Scott, a third."""
    hidden: Count = 24
    """Hidden units of the pointwise residual of forecasts."""
    channels: Count = 8
    """Hidden channels of convolutions."""
    units: Count = 12
    """Hidden units of the hybrids that are adapted."""
    starts: Count = 3
    """Random networks that begin; the one with the least training loss after ten steps goes on."""
    steps: Count = 35
    """Gauss–Newton steps on single intervals, the first ten included."""
    polish: Count = 8
    """Gauss–Newton steps on whole trajectories."""

    def __post_init__(self):
        Run.__post_init__(self)
        for option in ("parts", "cases", "shifts", "sizes"):
            distinct(f"--{option}", getattr(self, option))
        if self.sizes != tuple(sorted(self.sizes)):
            raise ValueError(f"--sizes must be in ascending order, got {self.sizes}")
        if self.points < 8:
            raise ValueError(
                f"--points must be at least 8, for a kernel and for fields with structure, got {self.points}"
            )


PAPER = Config()
PRESETS = {
    "paper": PAPER,
    "quick": replace(
        PAPER, preset="quick", seeds=1, starts=1, sizes=(1, 2), test=20, hidden=12, units=8, channels=6, steps=15,
        polish=3,
        parts=("forecast", "shifted"), shifts=("parameter_shift",),
        cases=("pointwise", "convolution, neighbours penalised", "physics alone: diffusion", "physics alone: complete"),
    ),
    "smoke": replace(
        PAPER, preset="smoke", seeds=1, starts=2, sizes=(1, 2), test=3, hidden=3, units=3, channels=2, steps=2,
        polish=1, points=8, cases=("pointwise", "convolution", "physics alone: diffusion"), shifts=("new_term",),
    ),
}  # fmt: skip
