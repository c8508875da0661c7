"""The options of `python -m experiments.real_flight`, and its presets."""

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

from experiments.real_flight.models import Model, RecipeName
from experiments.runner.options import Activation, Count, Positive, Run, distinct
from hybrid_jax.cli.log_options import SpeedOptions
from hybrid_jax.dynamics.vehicle_file import check_learned
from hybrid_jax.flights.checks.cleaning import Cleaning

# By default, the effects that a real vehicle adds to a rigid body; mass is weighed, not learned.
LEARN = ("Ix", "Iy", "Iz", "k_rotors", "drag", "aerodynamic_moment", "rate_damping", "velocity_lag", "cable_pull")
NANODRONE_STEPS = 50
ANOTHER_MANOEUVRE: tuple[RecipeName, ...] = ("frozen_rates", "torque_off", "staged")
PATHS = ("source", "target", "test", "vehicle", "columns")


@dataclass(frozen=True)
class RealFlightConfig(SpeedOptions, Run):
    """Train on the flights in --source, adapt to N windows of those in --target, test on held-out flights.

    A flight is a file: CSV (.csv, .csv.gz; columns t,px,py,pz,qw,qx,qy,qz,vx,vy,vz,wx,wy,wz,u0,u1,u2,u3 in SI units,
    z up, forward-left-up, rotor speeds in rad/s), any other CSV with --columns MAP.toml, PX4's .ulg, a log of a
    Crazyflie's SD card, a ROS bag or Betaflight's blackbox; hybrid-jax inspect FOLDER says what is in
    them. A check that fails stops the run before anything is trained, with exit code 3; --anyway goes on.

    Without --test, the target's flights are held out in turn (--folds). Without --target, nothing is adapted and the
    source's models are tested. No data? Try --simulated.

    Example: python -m experiments.real_flight --vehicle v.toml --source before/ --target after/ --n 100,1000
    """

    vehicle: Path | None = None
    """TOML file with a table [vehicle] (mass, inertia, rotor positions, …); see docs/howto/vehicle.md."""
    source: Path | None = None
    """Folder of the flights before the change, preferably many."""
    target: Path | None = None
    """Folder of the few flights after the change."""
    test: Path | None = None
    """Folder of test flights; by default the target's flights are held out in turn."""
    target_variant: str | None = None
    """Table [vehicle.VARIANT] of the vehicle file that applies to target and test, such as another mass."""
    anyway: bool = False
    """Train in spite of checks that failed. The report says so in its first line."""
    cleaning: Cleaning = field(default_factory=Cleaning)
    """Changes to every log, in this order; by default none. The report lists the effect of each."""
    simulated: bool = False
    """Simulate flights, write their logs to --out and use these."""
    protocol: Literal["horizons", "nanodrone"] = "horizons"
    """horizons: RMSE after each of --horizon. nanodrone: also the mean error of each step, summed over steps 1 to 50.
    Both predict from every sample of every test flight, open loop with the recorded inputs."""
    horizon: tuple[Count, ...] = (10, 50)
    """Numbers of intervals after which errors are measured."""
    n: tuple[Count, ...] = (100, 300, 1000)
    """Numbers of target windows to adapt to."""
    draw: Literal["random", "contiguous"] = "random"
    """random: windows from all training flights of the target. contiguous: consecutive windows, as from the first
    seconds of a flight; they cover far less flight."""
    folds: Count | None = None
    """Without --test: number of folds; by default 3, or as many as there are names."""
    folds_by: Literal["flight", "manoeuvre"] = "flight"
    """Test and training share no flight, or no manoeuvre (file name without number).
    With manoeuvre and without --target, flights in --test are held out by manoeuvre as well."""
    validate_by: Literal["flight", "manoeuvre"] | None = None
    """How flights are held out that stop the training or, in turn, choose a model. By default by flight; to predict
    other manoeuvres (--folds-by manoeuvre or --protocol nanodrone, without --target) by manoeuvre."""
    refit: bool = True
    """Without --target: train again with the validation flights, for the numbers of epochs that were best on them."""
    recipes: tuple[RecipeName, ...] | None = None
    """Training recipes. Each fold chooses by its own flights, left out of training in turn, among baselines and models
    of each recipe. By default turning; to predict other manoeuvres frozen_rates, torque_off and staged."""
    models: tuple[Model, ...] = ("hybrid", "no_physics", "physics_only")
    """hybrid: physics and network. no_physics: network with p' = v and the attitude's kinematics. physics_only."""
    learn: tuple[str, ...] | None = None
    """Names of learned physical parameters, and motor_time_constant for the rotors' lag; by default `learn` of the
    vehicle file, or else what real multirotors need."""
    hidden: Count = 32
    """Hidden units of the network."""
    activation: Activation = "relu"
    """Their activation. All but ReLU suit solvers of optimal control problems."""
    stride: Count = 5
    """Samples between the starts of two training windows of the source; for the target it is 1."""
    validation: Count = 200
    """Number of validation windows, evenly spaced in the validation flights."""
    epochs: Positive = 1.0
    """Factor on the numbers of epochs of the recipes."""
    batch_size: Count = 100
    """Windows per minibatch."""
    data_seed: int = 0
    """Seed of the folds and of simulated flights."""

    def __post_init__(self):
        Run.__post_init__(self)
        _ = self.reading  # topics are checked before anything is read
        distinct("--recipes", self.tried if self.recipes is None else self.recipes)
        for name in ("models", "horizon", "n"):
            distinct(f"--{name}", getattr(self, name))
        if min(self.n) < self.batch_size:
            raise ValueError(f"--n must each be at least --batch-size {self.batch_size}, got {self.n}")
        if self.learn is not None:
            check_learned(self.learn)
        if self.simulated and any(getattr(self, name) for name in PATHS):
            raise ValueError(f"--simulated makes its own logs: leave out {', '.join(f'--{name}' for name in PATHS)}")

    @property
    def longest(self) -> int:
        return max(*self.horizon, NANODRONE_STEPS if self.protocol == "nanodrone" else 1)

    @property
    def another_manoeuvre(self) -> bool:
        """Whether the test manoeuvres are absent from training."""
        asked = self.protocol == "nanodrone" or self.folds_by == "manoeuvre"
        return asked and self.target is None and not self.simulated

    @property
    def tried(self) -> tuple[RecipeName, ...]:
        """The recipes: as given, or the default for the task."""
        return self.recipes or (ANOTHER_MANOEUVRE if self.another_manoeuvre else ("turning",))

    @property
    def validated_by(self) -> Literal["flight", "manoeuvre"]:
        """How validation flights are held out: as given, or the default for the task."""
        return self.validate_by or ("manoeuvre" if self.another_manoeuvre else "flight")

    def described(self) -> dict[str, Any]:
        """All that fixes the results; of folders and files only the name, since flights are described by content."""
        options = Run.described(self)
        named = {name: None if options[name] is None else options[name].name for name in PATHS}
        return options | named | {"recipes": self.tried, "validate_by": self.validated_by}


PAPER = RealFlightConfig()
QUICK = replace(PAPER, preset="quick", seeds=2, n=(100, 1000), folds=2, epochs=0.5)
SMOKE = replace(
    PAPER, preset="smoke", seeds=1, n=(20,), horizon=(5, 10), folds=2, batch_size=20, hidden=8, validation=20,
    stride=50, epochs=0.05, recipes=("short",),
)  # fmt: skip
PRESETS = {"paper": PAPER, "quick": QUICK, "smoke": SMOKE}
