"""The options of `python -m experiments.real_flight`, and its presets."""

import math
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

from experiments.paper.config import distinct
from experiments.real_flight.recipes import RECIPES, Model, RecipeName
from experiments.runner.options import Run
from hybrid_jax import checks
from hybrid_jax.dynamics.vehicle_file import check_learned

# What a rigid body of known shape leaves open on a real vehicle; mass is weighed, not learned.
LEARN = (
    "Ix", "Iy", "Iz", "k_rotors", "drag", "aerodynamic_moment", "rate_damping", "velocity_lag", "cable_pull",
)  # fmt: skip
NANODRONE_STEPS = 50
ANOTHER_MANOEUVRE: tuple[RecipeName, ...] = ("frozen_rates", "torque_off", "staged")
FOLDERS = ("source", "target", "test")
FILES = ("vehicle", "columns")


@dataclass(frozen=True)
class Cleaning:
    """Changes to every log, in this order; by default none. What each did is in the report."""

    in_flight: bool = False
    """Cut out half a second and more in which the rotors hardly push: the vehicle stands on the ground."""
    resample: float | None = None
    """New interval between samples [s]."""
    longest_gap: float = 0.0
    """With resample: gaps and repeated samples up to this long [s] are interpolated across."""
    low_pass: float | None = None
    """Cut-off [Hz] of a zero-phase low-pass of states and motors."""
    align: bool = False
    """Shift the motors to the gyro, by the lag that each log's cross-correlation has."""
    delay: float = 0.0
    """Instead: shift the motors this much later [s]."""

    def __post_init__(self):
        if self.align and self.delay:
            raise ValueError("--cleaning.align finds the delay itself: leave --cleaning.delay out")
        if self.longest_gap and self.resample is None:
            raise ValueError("--cleaning.longest-gap needs --cleaning.resample")
        checks.not_negative("--cleaning.longest-gap", self.longest_gap)
        checks.number("--cleaning.delay", self.delay)
        for name in ("resample", "low_pass"):
            if getattr(self, name) is not None:
                checks.positive(f"--cleaning.{name.replace('_', '-')}", getattr(self, name))


@dataclass(frozen=True)
class RealFlightConfig(Run):
    """Train on the flights in --source, adapt to N windows of those in --target, score on flights not learned from.

    A flight is a file: CSV (.csv, .csv.gz; columns t,px,py,pz,qw,qx,qy,qz,vx,vy,vz,wx,wy,wz,u0,u1,u2,u3 in SI units,
    z up, forward-left-up, rotor speeds in rad/s), any other CSV with --columns MAP.toml, or PX4's .ulg.

    Without --test the target's flights take turns: each is tested by models that have not seen it (--folds).
    Without --target nothing is adapted: the source's models are tested. No data? Try --simulated.

    Example: python -m experiments.real_flight --vehicle v.toml --source before/ --target after/ --n 100,1000
    """

    vehicle: Path | None = None
    """TOML file with a table [vehicle] (mass, inertia, rotor positions, …); see docs/real_flight.md."""
    source: Path | None = None
    """Folder of plenty of flights, from before the change."""
    target: Path | None = None
    """Folder of the few flights from after the change."""
    test: Path | None = None
    """Folder of flights to score on; by default the target's own take turns."""
    target_variant: str | None = None
    """Table [vehicle.VARIANT] of the vehicle file that holds in target and test, such as another mass."""
    columns: Path | None = None
    """TOML file that says what the columns, units and frames of CSV logs are."""
    polynomial: tuple[float, ...] = ()
    """Of ULog files without ESC telemetry: rotor speed [rad/s] = c0 + c1 command + c2 command² …"""
    cleaning: Cleaning = field(default_factory=Cleaning)
    simulated: bool = False
    """Fly the simulator, write its logs to --out and use these."""
    protocol: Literal["horizons", "nanodrone"] = "horizons"
    """horizons: RMSE after each of --horizon. nanodrone: also the mean error of each step, summed over steps 1 to 50.
    Both from every sample of every test flight, open loop with the recorded inputs."""
    horizon: tuple[int, ...] = (10, 50)
    """Intervals after which errors are scored."""
    n: tuple[int, ...] = (100, 300, 1000)
    """Windows of the target to adapt to."""
    draw: Literal["random", "contiguous"] = "random"
    """Windows drawn at random from all training flights of the target, or in a row, as the first seconds of a flight
    would give them: far less flight."""
    folds: int | None = None
    """Without --test: how many times the flights are parted anew; by default 3, or as many as there are names."""
    folds_by: Literal["flight", "manoeuvre"] = "flight"
    """What is tested has no flight, or no manoeuvre (file name without number), in common with what is learned from.
    With manoeuvre and without --target, flights in --test take turns by manoeuvre as well."""
    validate_by: Literal["flight", "manoeuvre"] | None = None
    """How the flights that stop the training are held out of those to learn from. By default by flight; where another
    manoeuvre is to be predicted (--folds-by manoeuvre or --protocol nanodrone, and no --target), by manoeuvre."""
    refit: bool = True
    """Without --target: train once more, on the validation flights as well, for as many epochs as these found best."""
    recipes: tuple[RecipeName, ...] | None = None
    """Ways to train; of several, the one whose hybrid does best on each fold's validation flights is taken. By default
    turning; where another manoeuvre is to be predicted, frozen_rates, torque_off and staged."""
    models: tuple[Model, ...] = ("hybrid", "no_physics", "physics_only")
    """hybrid: physics and network. no_physics: network with p' = v and the attitude's kinematics. physics_only."""
    learn: tuple[str, ...] | None = None
    """Names of what physics may learn, and motor_time_constant for the rotors' lag; by default the vehicle file's
    `learn`, or else what real multirotors need."""
    hidden: int = 32
    """Hidden units of the network."""
    stride: int = 5
    """Samples between the starts of two training windows of the source; of the target every sample is one."""
    validation: int = 200
    """Validation windows, evenly spaced in the validation flights."""
    epochs: float = 1.0
    """Factor on all epochs of the recipes."""
    batch_size: int = 100
    """Windows in a minibatch."""
    data_seed: int = 0
    """Of how flights are dealt into folds, and of simulated ones."""

    def __post_init__(self):
        Run.__post_init__(self)
        for name in ("hidden", "stride", "validation", "batch_size", *(("folds",) if self.folds else ())):
            if getattr(self, name) < 1:
                raise ValueError(f"--{name.replace('_', '-')} must be at least 1, got {getattr(self, name)}")
        distinct("--recipes", self.tried if self.recipes is None else self.recipes)
        distinct("--models", self.models)
        distinct("--horizon", tuple(map(str, self.horizon)))
        distinct("--n", tuple(map(str, self.n)))
        if min(self.horizon) < 1:
            raise ValueError(f"--horizon must be at least 1, got {self.horizon}")
        if min(self.n) < self.batch_size:
            raise ValueError(f"--n must each be at least --batch-size {self.batch_size}, got {self.n}")
        if not 0 < self.epochs < math.inf:
            raise ValueError(f"--epochs must be a positive number, got {self.epochs}")
        if self.learn is not None:
            check_learned(self.learn)
        if self.simulated and any(getattr(self, name) for name in (*FOLDERS, *FILES)):
            raise ValueError("--simulated makes its own logs: leave --vehicle, --source, --target and --test out")

    def require_flights(self) -> None:
        """Refuse a configuration of which nothing can be flown; apart from the other checks, as presets have no paths.

        Raises:
            ValueError: what is missing.
        """
        if not self.simulated and (self.vehicle is None or self.source is None):
            raise ValueError("--vehicle FILE and --source FOLDER are needed, or --simulated; --help says what they are")

    @property
    def longest(self) -> int:
        """Intervals of a test window."""
        return max(*self.horizon, NANODRONE_STEPS if self.protocol == "nanodrone" else 1)

    @property
    def another_manoeuvre(self) -> bool:
        """Whether manoeuvres are to be predicted that nothing is learned from."""
        asked = self.protocol == "nanodrone" or self.folds_by == "manoeuvre"
        return asked and self.target is None and not self.simulated

    @property
    def tried(self) -> tuple[RecipeName, ...]:
        """The recipes: those asked for, or else what suits the question."""
        usual: tuple[RecipeName, ...] = ("turning",)
        return self.recipes or (ANOTHER_MANOEUVRE if self.another_manoeuvre else usual)

    @property
    def validated_by(self) -> Literal["flight", "manoeuvre"]:
        """By what validation flights are held out: as asked for, or else as suits the question."""
        return self.validate_by or ("manoeuvre" if self.another_manoeuvre else "flight")

    def described(self) -> dict[str, Any]:
        """All that fixes the results; of folders and files the name alone, since the flights are described apart."""
        options = Run.described(self)
        named = {name: None if options[name] is None else options[name].name for name in (*FOLDERS, *FILES)}
        return options | named | {"recipes": self.tried, "validate_by": self.validated_by}


PAPER = RealFlightConfig()
QUICK = replace(PAPER, preset="quick", seeds=2, n=(100, 1000), folds=2, epochs=0.5)
SMOKE = replace(
    PAPER, preset="smoke", seeds=1, n=(20,), horizon=(5, 10), folds=2, batch_size=20, hidden=8, validation=20,
    stride=50, epochs=0.05,
    recipes=("short",), models=("hybrid", "physics_only"),
)  # fmt: skip
PRESETS = {"paper": PAPER, "quick": QUICK, "smoke": SMOKE}
assert {*RecipeName.__args__} == {*RECIPES}
