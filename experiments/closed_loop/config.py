"""Options of the closed-loop experiment, and its presets."""

from dataclasses import dataclass, replace
from typing import Annotated, Literal, get_args

from experiments.flying.scenario import Reference, hardware
from experiments.paper.config import QUICK, SMOKE, AllModels, Config, ResidualInputs, preset_like
from experiments.runner.options import Count, Named, NotNegative, Positive, Several, distinct
from hybrid_jax.control import Controller, Hardware
from hybrid_jax.vehicle import IRIS

THREE: tuple[Reference, ...] = ("hover", "figure_eight", "low_pass")


@dataclass(frozen=True)
class ClosedLoopConfig(AllModels):
    """Fly a model predictive controller with each model, before and after adaptation.

    Models are trained as in param_shift and external_force, whose stages in --cache are reused. Models that adapt use
    the smallest and the largest of --n-target; models that do not adapt also fly the unchanged vehicle.
    """

    seconds: Positive = 10.0
    """Length of a flight [s]."""
    references: Several[Reference] = get_args(Reference)
    """References flown at home."""
    away: Positive = 60.0
    """Distance of flights away from home [m]."""
    away_references: tuple[Reference, ...] | None = None
    """Subset of --references to fly away from home; by default hover, figure_eight and low_pass."""
    bandwidth: Annotated[Positive, Named(name="observer-bandwidth")] = 10.0
    """Bandwidth of the disturbance observer [rad/s]."""
    noise: NotNegative = 0.0
    """White noise on the states that controller and observer see; 1 is typical of motion capture and a gyroscope."""
    latency: NotNegative = 0.0
    """Latency from a sample to its command [s], a multiple of 0.01. Controller and observer model it."""
    rotor_lag: NotNegative = 0.0
    """Time constant of the rotors [s]. Controller and observer model it."""
    invariant_inputs: ResidualInputs = "near_ground"
    """Inputs of the translation- and yaw-invariant residual (see --residual-inputs)."""
    invariant_outputs: Literal["accelerations", "wrench", "rotors"] = "rotors"
    """Outputs of this residual (see --residual-outputs)."""
    invariant_linear: bool = True
    """Give it a linear skip connection (see --residual-linear)."""
    invariant_hidden: Count = 64
    """Hidden units of this residual, and of the network that all rotors share."""
    invariant_norm: Literal["batch", "none"] = "none"
    """Normalisation of this residual's hidden layer."""
    invariant_rates: tuple[Positive, ...] = (3e-3, 3e-4, 3e-5)
    """Learning rates of this residual in pre-training, one stage each; the rates of θ_p decay by the same factors."""
    invariant_source: Count = 10_000
    """Largest number of source trajectories for this residual."""
    invariant_epochs: Count = 2000
    """Largest number of epochs for this residual."""
    invariant_offset: Positive | None = 0.3
    """Learning rate of this residual's output bias in adaptation [m/s² or rad/s² per step]; see --rates.offset."""
    invariant_disturbance: Literal["needed", "always"] = "needed"
    """Fit a constant disturbance by least squares always, or only if it lowers the leave-one-out error."""
    calls: Count = 300
    """Calls of the controller to time."""

    def __post_init__(self):
        Config.__post_init__(self)
        if self.away_references is not None:
            distinct("--away-references", self.away_references)
        unknown = [name for name in self.flown_away if name not in self.references]
        if unknown:
            known = ", ".join(self.references)
            raise ValueError(f"--away-references must be among --references ({known}), got {', '.join(unknown)}")
        if not self.invariant_rates:
            raise ValueError("--invariant-rates must be at least one")
        if self.draws > 1:
            raise ValueError(f"--draws must be 1: each model of a seed is flown, got {self.draws}")
        if self.seconds < 1:
            raise ValueError(f"--seconds must be at least 1, got {self.seconds}")
        if self.residual_outputs != "all":
            why = "no_physics must write all derivatives; see --invariant-outputs"
            raise ValueError(f"--residual-outputs {self.residual_outputs}: {why}")
        self.hardware().delay(self.controller().period)

    def hardware(self) -> Hardware:
        return hardware(self.noise, self.latency, self.rotor_lag)

    def controller(self) -> Controller:
        return Controller(IRIS, rotor_lag=self.rotor_lag)

    @property
    def flown_away(self) -> tuple[Reference, ...]:
        if self.away_references is not None:
            return self.away_references
        return tuple(name for name in THREE if name in self.references)

    @property
    def ends(self) -> tuple[int, ...]:
        """The smallest and the largest of --n-target, if they differ."""
        return tuple(dict.fromkeys((min(self.sizes), max(self.sizes))))

    def invariant(self) -> Config:
        """The configuration for the invariant residual, with the shared options so that stages are reused."""
        first, *others = self.invariant_rates
        offset = self.rates.offset if self.invariant_offset is None else self.invariant_offset
        return preset_like(
            Config,
            self,
            sizes=self.ends,
            pool=self.shared_pool(),
            source_train=min(self.source_train, self.invariant_source),
            max_epochs=min(self.max_epochs, self.invariant_epochs),
            rates=replace(self.rates, offset=offset, pretraining=first, decay=tuple(rate / first for rate in others)),
            residual_inputs=self.invariant_inputs,
            residual_outputs=self.invariant_outputs,
            residual_linear=self.invariant_linear,
            hidden=self.invariant_hidden,
            norm=self.invariant_norm,
        )


PRESETS = {
    "paper": ClosedLoopConfig(),
    "quick": preset_like(
        ClosedLoopConfig, QUICK, sizes=(100, 1000), seconds=6.0, references=THREE, away_references=("hover",),
    ),
    "smoke": preset_like(
        ClosedLoopConfig, SMOKE, sizes=(20,), source_train=20, seconds=1.0, references=("hover", "low_pass"),
        away_references=("hover",), calls=20,
        # The shape of the paper's network, so that few programs are compiled.
        invariant_inputs="no_xy_yaw", invariant_outputs="accelerations", invariant_linear=False, invariant_hidden=8,
        invariant_norm="batch", invariant_disturbance="always",
    ),
}  # fmt: skip
