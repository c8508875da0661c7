"""Options of the experiment that adapts in the air, and its presets."""

from dataclasses import dataclass
from typing import Annotated, Literal, get_args

from experiments.flying.scenario import Reference, hardware
from experiments.paper.config import WorldName
from experiments.runner.options import Named, NotNegative, Positive, Run, Several
from experiments.worlds.flights import WORLDS
from experiments.worlds.rotorpy import RotorPy
from experiments.worlds.world import DT
from hybrid_jax.control import Controller, Hardware

Change = Literal["parameter_shift", "off_centre_load", "external_force", "weak_rotor", "doubled_drag", "nothing"]
Agent = Literal["unadapted", "observer", "l1", "least_squares", "online", "oracle"]


@dataclass(frozen=True)
class OnlineConfig(Run):
    """Change the simulated vehicle in the air, and fly every agent along every reference through every change."""

    worlds: Several[WorldName] = get_args(WorldName)
    """Simulated vehicles. iris: of the other experiments. hummingbird, crazyflie: of RotorPy."""
    seconds: Positive = 4.0
    """Length of a flight after the change [s]."""
    changes: Several[Change] = get_args(Change)
    """Changes in the air."""
    references: Several[Reference] = ("hover", "figure_eight", "fast_figure_eight", "low_pass")
    """References to fly."""
    agents: Several[Agent] = get_args(Agent)
    """Agents to compare."""
    noise: NotNegative = 1.0
    """White noise on the measured states; 1 is typical of motion capture and a gyroscope."""
    latency: NotNegative = 0.01
    """Latency from a sample to its command [s], a multiple of 0.01."""
    rotor_lag: NotNegative = 0.03
    """Time constant of the Iris's rotors [s]; RotorPy's vehicles have their own."""
    bandwidth: Annotated[Positive, Named(name="observer-bandwidth")] = 8.0
    """Bandwidth of the disturbance observer [rad/s]."""
    l1_cutoff: Positive = 8.0
    """Cutoff of the low-pass filter of L1 adaptive augmentation [rad/s]."""

    def __post_init__(self):
        Run.__post_init__(self)
        if self.seconds < 1.5:
            raise ValueError(f"--seconds must be at least 1.5, got {self.seconds}")
        if self.distributed:
            raise ValueError("--distributed: this experiment runs in one process")
        self.hardware(self.worlds[0]).delay(0.01)

    def hardware(self, world: str) -> Hardware:
        own = WORLDS[world]
        lag = own.nominal.lag if isinstance(own, RotorPy) else self.rotor_lag
        return hardware(self.noise, self.latency, lag)

    def controller(self, world: str) -> Controller:
        return Controller(WORLDS[world].vehicle, rotor_lag=self.hardware(world).rotor_lag)

    @property
    def periods(self) -> int:
        """Periods of a flight before and after the change, equal since both run the same program."""
        return round(self.seconds / DT)


PRESETS = {
    "paper": OnlineConfig(),
    "quick": OnlineConfig(preset="quick", seeds=2),
    "smoke": OnlineConfig(
        preset="smoke", seeds=1, worlds=("hummingbird",), seconds=1.5, changes=("external_force", "nothing"),
        references=("hover",), agents=("unadapted", "online", "oracle"),
    ),
}  # fmt: skip
