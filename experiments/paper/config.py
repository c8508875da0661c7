"""The paper's protocol as data: sizes, rates, patience, and the presets (paper, App. A)."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar

from experiments.flying.changes import CHANGES
from experiments.paper.rates import AllPatience, AllRates, Patience, Rates, Stopping
from experiments.reporting.names import CONSTANT_DISTURBANCE, HYBRID, NO_PHYSICS, PHYSICS_ONLY
from experiments.runner import options
from experiments.runner.options import Activation, Count, CountFromZero, NotNegative, Positive, Run, Several, factors
from hybrid_jax.dynamics.rigid_body import LEARNED
from hybrid_jax.integrate import SOLVERS
from hybrid_jax.networks.mlp import NORMS
from hybrid_jax.training.loss import REGULARISERS

TABLE_SIZES = (100, 300, 500, 700, 1000)  # the columns of the paper's table of fine-tuning rates
FLIGHT = 110  # windows of a flight, 11 s
HELD_BACK = 5  # with --validation own, one in so many of the N windows stops the training
MOST = 10_000_000  # trajectories; these alone take 7 GB
FITTED = len(LEARNED) + 6  # what constant_disturbance fits: θ_p, and steady accelerations, linear and angular
Kind = TypeVar("Kind", bound="Config")
MODELS = (HYBRID, NO_PHYSICS, PHYSICS_ONLY, CONSTANT_DISTURBANCE)
CHANGED = tuple(domain.name for domain in CHANGES)
if TYPE_CHECKING:
    Model = str
    RegulariserName = str
    SolverName = str
    Change = str
    Norm = str
else:  # the command line offers what the registries hold
    Model = Literal[MODELS]
    RegulariserName = Literal[("none", *REGULARISERS)]
    SolverName = Literal[tuple(SOLVERS)]
    Change = Literal[CHANGED]
    Norm = Literal[tuple(NORMS)]
Training = Literal["physics_first", "joint"]
WorldName = Literal["iris", "hummingbird", "crazyflie"]
ResidualInputs = Literal["all", "no_xy", "no_xy_yaw", "near_ground", "body"]
ResidualOutputs = Literal["all", "accelerations", "wrench", "rotors"]


@dataclass(frozen=True)
class Encoding:
    """The encoder of Expert Augmentation, which estimates θ_p from the past; the paper gives no details."""

    box: tuple[float, float] = (0.5, 2.0)
    """Range of factors on θ_p in augmented flights, uniform in the logarithm."""
    hidden: Count = 128
    """Units in each of the encoder's two hidden layers."""
    rate: NotNegative = 1e-3
    """Adam's learning rate."""
    weight: NotNegative = 1.0
    """Weight of the mean squared error of log θ̂_p, relative to the prediction error."""
    stopping: Stopping = Stopping(100, 60)
    """Early stopping by the prediction error on source and augmented validation flights."""
    max_epochs: Count = 400
    """Cap on the encoder's epochs."""


@dataclass(frozen=True)
class Config(Run):
    """Experiments in simulation share most of their options."""

    sizes: Annotated[Several[int], options.Target] = TABLE_SIZES
    """N, target trajectories to train on. Rates and patience are those of the nearest size in the paper's table."""
    pool: int | None = None
    """Target trajectories from which a seed draws its N; by default as many as the largest N."""
    draw: Annotated[Literal["random", "contiguous"], options.Named(name="sampling")] = "random"
    """Which N target trajectories. random: from many flights, as in the paper. contiguous: from the start of
    one flight (ten seconds for 100 trajectories), or of as few flights as possible."""
    draws: Count = 1
    """Draws of target trajectories for each seed; contiguous draws use different flights, the same for all seeds."""
    source_train: Count = 10_000
    """Source trajectories for pre-training."""
    validation: Count | Literal["own"] = 1000
    """Validation trajectories, in the source and in the target. own: only the N target trajectories, with the
    last fifth held out if a method needs early stopping."""
    n_test: Count = 1000
    """Target test trajectories."""
    data_seed: CountFromZero = 0
    """Seed of all flights."""
    hidden: Count = 64
    """Hidden units of f_d."""
    inputs: Annotated[Literal["hover", "raw"], options.Named(name="rotor-scaling")] = "hover"
    """Scaling of rotor speeds for f_d. hover: (u − hover) / (hover / 10); raw: u in rad/s."""
    norm: Norm = "batch"
    """Normalisation of f_d's hidden layer."""
    activation: Activation = "relu"
    """Activation of f_d's hidden layer. For optimal control you should not use ReLU."""
    residual_inputs: ResidualInputs = "all"
    """Inputs of f_d from the state. no_xy: without p_x, p_y. no_xy_yaw: nor yaw. near_ground: also each rotor's
    distance to the ground. body: altitude, and velocity, rates and gravity in the body frame."""
    residual_outputs: ResidualOutputs = "all"
    """Outputs of f_d. all: 13 derivatives. accelerations: v̇ and ω̇. wrench: these as a force and a torque, so that Ix
    and Iy act on them. rotors: also the thrust of each rotor, by one network that all rotors share."""
    residual_linear: bool = False
    """Add a linear skip connection to f_d; both start at zero."""
    guess: Annotated[tuple[float, float], options.Named(name="init-range")] = (0.8, 1.25)
    """θ_p starts at nominal times a random factor in this range."""
    perturbed_by: Annotated[Positive | None, options.Named(name="init-offset")] = None
    """Instead of --init-range, with this value x: θ_p starts at nominal × (1 + x) or nominal / (1 + x), at random."""
    noise: NotNegative = 0.0
    """White noise on the states of training and validation flights; 1 is typical of motion capture and a gyroscope."""
    noise_on: Literal["all", "target"] = "all"
    """Flights with noise. all: before and after the change. target: only after it."""
    regulariser: RegulariserName = "trajectory_correlation"
    """Penalty that keeps f_d from replacing f_p."""
    regulariser_weight: NotNegative = 1e-3
    """Weight λ of the penalty."""
    solver: SolverName = "rk4"
    """Integrator, one step for each input interval of 0.01 s."""
    batch_size: Count = 100
    """Trajectories in a minibatch."""
    max_epochs: Count = 2000
    """Cap on epochs; the report marks runs that reach it."""
    rates: Rates = Rates()
    patience: Patience = Patience()

    def __post_init__(self):
        Run.__post_init__(self)
        factors("--init-range", self.guess)
        batch = f"--batch-size {self.batch_size}"
        if min(self.sizes) < self.batch_size:
            raise ValueError(f"--n-target must each be at least {batch}, got {self.sizes}")
        if self.source_train < self.batch_size:
            raise ValueError(f"--source-train must be at least {batch}, got {self.source_train}")
        self._check_draws()
        if self.pooled() + self.source_train + self.validating() + self.n_test > MOST:
            named = "--n-target, --draws, --pool, --source-train, --validation and --n-test"
            raise ValueError(f"{named} must request at most {MOST:,} trajectories together")
        chosen = {*getattr(self, "models", ()), *getattr(self, "methods", ())}  # empty where there is no choice
        if CONSTANT_DISTURBANCE in chosen and min(self.sizes) <= FITTED:
            needed = f"more than the {FITTED} parameters of {CONSTANT_DISTURBANCE}"
            raise ValueError(f"--n-target must each be {needed}, got {self.sizes}")
        if NO_PHYSICS in chosen and self.residual_outputs != "all":
            refused = f"--residual-outputs {self.residual_outputs}"
            raise ValueError(f"{refused}: no_physics needs all derivatives: leave it out")
        # Physics alone has nothing to normalise.
        if self.norm == "batch" and self.batch_size < 2 and chosen != {PHYSICS_ONLY}:
            raise ValueError(f"--batch-size must be at least 2 with --norm batch, got {self.batch_size}")
        if self.pooled() < max(self.sizes):
            raise ValueError(f"--pool must be at least the largest of --n-target {self.sizes}, got {self.pool}")
        for name in ("rates.hybrid", "rates.no_physics", "patience.hybrid_minimum", "patience.hybrid_patience"):
            group, entry = name.split(".")
            if len(getattr(getattr(self, group), entry, TABLE_SIZES)) != len(TABLE_SIZES):
                raise ValueError(f"--{name.replace('_', '-')} must have one entry for each of {TABLE_SIZES}")

    def _check_draws(self) -> None:
        if self.draw == "contiguous" and self.pool is not None:
            raise ValueError("--pool is for --sampling random: leave it out")
        if self.validation == "own" and min(self.sizes) < HELD_BACK:
            raise ValueError(f"--n-target must each be at least {HELD_BACK} with --validation own, got {self.sizes}")

    def pooled(self) -> int:
        """Target trajectories to draw from; with contiguous for all draws."""
        if self.draw == "contiguous":
            return self.draws * self.flown_each() * self.windows_each()
        return max(self.sizes) if self.pool is None else self.pool

    def shared_pool(self) -> int | None:
        """The option --pool with which another choice of sizes draws the same trajectories."""
        return self.pooled() if self.draw == "random" else None

    def flown_each(self) -> int:
        return -(-max(self.sizes) // FLIGHT)

    def windows_each(self) -> int:
        return -(-max(self.sizes) // self.flown_each())

    def runs(self) -> int:
        return self.draws * self.seeds

    def validating(self) -> int:
        """Validation trajectories of the source, in the paper's ratio of one to ten."""
        return max(self.source_train // 10, 1) if self.validation == "own" else self.validation


@dataclass(frozen=True)
class AllModels(Config):
    """Also train a network without physics."""

    rates: AllRates = AllRates()
    patience: AllPatience = AllPatience()


@dataclass(frozen=True)
class AdaptationConfig(AllModels):
    """Pre-train on source flight, adapt to the target with N short trajectories, and test."""

    models: Several[Model] = MODELS
    """Which models to compare. constant_disturbance: the source's hybrid with θ_p and a constant
    disturbance fitted by least squares."""
    target_only: bool = True
    """Train every model on the N target trajectories from scratch, too."""
    source_flights: Path | None = None
    """A file of `python -m experiments.make_flights --domain source`; by default flights are simulated and cached."""
    target_flights: Path | None = None
    """The same for the target, with the splits train, validation and test."""


@dataclass(frozen=True)
class OneFlight(Config):
    """After a change you have one short flight with sensor noise, and no other data."""

    sizes: Annotated[Several[int], options.Target] = (100,)
    """N, windows of 0.1 s: one number."""
    draw: Annotated[Literal["random", "contiguous"], options.Named(name="sampling")] = "contiguous"
    """Which N target trajectories. contiguous: from the start of one flight (ten seconds for 100
    trajectories). random: from many flights, as in the paper."""
    draws: Count = 4
    """Draws of target trajectories; each seed's source adapts to one at a time."""
    validation: Count | Literal["own"] = "own"
    """own: only the N target trajectories. Or the number of validation trajectories, as in the source."""
    noise: NotNegative = 1.0
    """White noise on the states of all flights but the test flights; 1 is typical of motion capture and a gyroscope."""
    changes: Several[Change] = CHANGED
    """Changes of the vehicle."""
    source_training: Annotated[Training, options.Named(name="pretraining")] = "physics_first"
    """physics_first: physics with drag and moments by least squares, then the network on what is left. joint: physics
    and network at once, as in the paper."""
    worlds: Several[WorldName] = ("iris", "hummingbird")
    """Simulated vehicles. iris: our own simulator. hummingbird, crazyflie: vehicles of RotorPy."""

    def __post_init__(self):
        Config.__post_init__(self)
        if len(self.sizes) != 1:
            raise ValueError(f"--n-target must be one number, got {self.sizes}")


# The same for every preset of these experiments.
ONE_FLIGHT: dict[str, Any] = {"noise": 1.0, "draw": "contiguous", "validation": "own"}


def preset_like(kind: type[Kind], like: Config, **changes: Any) -> Kind:
    """Return a configuration with another's shared options, except sizes and pool, and the changes."""
    shared = {name: getattr(like, name) for name in Config.__dataclass_fields__ if name not in ("sizes", "pool")}
    for name in ("rates", "patience"):
        own = type(kind.__dataclass_fields__[name].default)
        shared[name] = own(**{each: getattr(shared[name], each) for each in own.__dataclass_fields__})
    return kind(**shared | changes)


def column(size: int) -> int:
    """Return the column of the paper's table nearest to a size, by ratio."""
    return min(range(len(TABLE_SIZES)), key=lambda i: max(size / TABLE_SIZES[i], TABLE_SIZES[i] / size))


PAPER = AdaptationConfig()
QUICK = replace(
    PAPER, preset="quick", seeds=3, sizes=(100, 300), models=(HYBRID, NO_PHYSICS, CONSTANT_DISTURBANCE),
    source_train=1000, validation=200, n_test=200, max_epochs=200,
)  # fmt: skip
SMOKE = replace(
    PAPER, preset="smoke", seeds=1, sizes=(20,), source_train=40, validation=20, n_test=20, batch_size=20, max_epochs=3,
    hidden=32,
)  # fmt: skip
# Both ends of the sizes, and less source flight, learnt at rates that converge in it: under a minute on two cores.
BOTH_ENDS = replace(
    QUICK, sizes=(100, 1000), target_only=False, source_train=3000, validation=100, max_epochs=600,
    rates=AllRates(pretraining=1e-3, no_physics_target_only=1e-3, no_physics=(1e-4, 3e-4, 3e-4, 3e-4, 5e-4)),
    patience=AllPatience(
        hybrid_pretraining=Stopping(70, 15), no_physics_pretraining=Stopping(100, 15), no_physics=Stopping(150, 20)
    ),
)  # fmt: skip
PRESETS = {"paper": PAPER, "quick": BOTH_ENDS, "smoke": SMOKE}
