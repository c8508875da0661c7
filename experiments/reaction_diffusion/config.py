"""Options and presets."""

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Annotated, Literal, NamedTuple, get_args

from experiments.runner.options import Count, Named, Run, Several, Target


class Case(NamedTuple):
    """A line of the table of forecasts: `kernel` 0 is no residual; physics is "diffusion", "complete" or "none"."""

    name: str
    kernel: int = 1
    physics: str = "diffusion"
    penalty: str | None = None
    weight: float = 0.0
    noise: float = 0.0
    seeds: int = 1


POINTWISE, LOCAL = "pointwise", "convolution, neighbours penalised"
CASES = (
    Case(POINTWISE, seeds=3),
    Case("pointwise, noise 0.001", noise=1e-3),
    Case("pointwise, noise 0.01", noise=1e-2),
    Case("convolution", 3),
    Case("convolution, least action", 3, penalty="residual_norm", weight=1e-5),
    Case("convolution, correlation (paper)", 3, penalty="trajectory_correlation", weight=1e-3),
    Case(LOCAL, 3, penalty="neighbour_weights", weight=1.0, seeds=3),
    Case("no physics, convolution", 3, physics="none"),
    Case("physics alone: diffusion", 0),
    Case("physics alone: complete", 0, physics="complete"),
)
Part = Literal["forecast", "shifted", "gray_scott"]
if TYPE_CHECKING:
    CaseName = str
else:
    CaseName = Literal[tuple(case.name for case in CASES)]
Shift = Literal["parameter_shift", "new_term"]


@dataclass(frozen=True)
class Config(Run):
    """Learn and adapt reaction-diffusion equations."""

    seeds: Count = 10
    """Trials: initial weights and training trajectories. Forecasts use at most three."""
    parts: Several[Part] = get_args(Part)
    """Which parts to run. forecast: as APHYNITY. shifted: adapt to changed equations. gray_scott: as Neural Context
    Flows."""
    cases: Several[CaseName] = tuple(case.name for case in CASES)
    """Lines of the table of forecasts."""
    shifts: Annotated[Several[Shift], Named(name="changes")] = get_args(Shift)
    """parameter_shift: a × 2, b ÷ 2, k × 2. new_term: u_t has a term that is not in the source."""
    sizes: Annotated[Several[Count], Target] = (1, 2, 4, 8)
    """Trajectories to adapt to."""
    points: Count = 32
    """Grid points along each axis."""
    n_test: Count = 100
    """Test trajectories of forecasts; a third of these after a shift and for Gray–Scott."""
    hidden: Count = 24
    """Hidden units of the pointwise residual of forecasts."""
    channels: Count = 8
    """Hidden channels of convolutions."""
    units: Count = 12
    """Hidden units of the hybrids that are adapted."""
    starts: Count = 3
    """Random networks to start with; that with the least training loss after ten steps is continued, for Gray–Scott
    after twenty."""
    steps: Annotated[Count, Named(name="iterations")] = 35
    """Gauss–Newton steps on single intervals, the first ten included; for Gray–Scott at most four times as many."""
    polish: Count = 8
    """Gauss–Newton steps on whole trajectories."""

    def __post_init__(self):
        Run.__post_init__(self)
        if self.sizes != tuple(sorted(self.sizes)):
            raise ValueError(f"--n-target must be in ascending order, got {self.sizes}")
        if self.points < 8:
            raise ValueError(f"--points must be at least 8, to resolve the fields, got {self.points}")


PAPER = Config()
PRESETS = {
    "paper": PAPER,
    "quick": replace(
        PAPER, preset="quick", seeds=1, starts=1, sizes=(1, 2), n_test=20, hidden=12, units=8, channels=6, steps=15,
        polish=3,
        parts=("forecast", "shifted"), shifts=("parameter_shift",),
        cases=("pointwise", "convolution, neighbours penalised", "physics alone: diffusion", "physics alone: complete"),
    ),
    "smoke": replace(
        PAPER, preset="smoke", seeds=1, starts=2, sizes=(1, 2), n_test=3, hidden=3, units=3, channels=2, steps=2,
        polish=1, points=8, cases=("pointwise", "convolution", "physics alone: diffusion"), shifts=("new_term",),
    ),
}  # fmt: skip
