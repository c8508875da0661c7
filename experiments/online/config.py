"""Options of the experiment that adapts in the air, and its presets."""

from dataclasses import dataclass
from typing import Annotated, Literal, get_args

from experiments.flying.scenario import Reference, hardware
from experiments.runner.options import Named, NotNegative, Positive, Run, distinct
from hybrid_jax.control import Controller, Hardware
from hybrid_jax.vehicle import IRIS

Change = Literal["parameter_shift", "off_centre_load", "external_force", "weak_rotor", "doubled_drag", "nothing"]
Agent = Literal["unadapted", "observer", "l1", "least_squares", "online", "oracle"]


@dataclass(frozen=True)
class OnlineConfig(Run):
    """Change the simulated vehicle in the air, and fly every agent along every reference through every change."""

    seconds: Positive = 4.0
    """Length of a flight after the change [s]."""
    changes: tuple[Change, ...] = get_args(Change)
    """Changes in the air."""
    references: tuple[Reference, ...] = ("hover", "figure_eight", "fast_figure_eight", "low_pass")
    """References to fly."""
    agents: tuple[Agent, ...] = get_args(Agent)
    """Agents to compare."""
    noise: NotNegative = 1.0
    """White noise on the measured states; 1 is typical of motion capture and a gyroscope."""
    latency: NotNegative = 0.01
    """Latency from a sample to its command [s], a multiple of 0.01."""
    rotor_lag: NotNegative = 0.03
    """Time constant of the rotors [s]."""
    bandwidth: Annotated[Positive, Named(name="observer-bandwidth")] = 8.0
    """Bandwidth of the disturbance observer [rad/s]."""
    l1_cutoff: Positive = 8.0
    """Cutoff of the low-pass filter of L1 adaptive augmentation [rad/s]."""

    def __post_init__(self):
        Run.__post_init__(self)
        for name in ("changes", "references", "agents"):
            distinct(f"--{name}", getattr(self, name))
        if self.seconds < 1.5:
            raise ValueError(f"--seconds must be at least 1.5, got {self.seconds}")
        if self.distributed:
            raise ValueError("--distributed: this experiment runs in one process")
        self.hardware().delay(0.01)

    def hardware(self) -> Hardware:
        return hardware(self.noise, self.latency, self.rotor_lag)

    def controller(self) -> Controller:
        return Controller(IRIS, rotor_lag=self.rotor_lag)

    @property
    def periods(self) -> int:
        """Periods of a flight before and after the change, equal since both run the same program."""
        return round(self.seconds / self.controller().period)


PRESETS = {
    "paper": OnlineConfig(),
    "quick": OnlineConfig(preset="quick", seeds=2),
    "smoke": OnlineConfig(
        preset="smoke", seeds=1, seconds=1.5, changes=("external_force", "nothing"), references=("hover",),
        agents=("unadapted", "online", "oracle"),
    ),
}  # fmt: skip
