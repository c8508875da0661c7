"""The paper's protocol as data: sizes, rates, patience, and what each preset makes of them (paper, App. A)."""

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import platformdirs

from hybrid_jax.loss import REGULARISERS

TABLE_SIZES = (100, 300, 500, 700, 1000)  # the columns of the paper's table of fine-tuning rates
Model = Literal["hybrid", "no_physics", "physics_only"]
RegulariserName = Literal["none", "trajectory_correlation", "inner_product", "cosine", "pearson", "residual_norm"]
assert {*RegulariserName.__args__} == {"none", *REGULARISERS}


@dataclass(frozen=True)
class Rates:
    """Adam's learning rates; a tuple has one for each of the sizes 100, 300, 500, 700, 1000."""

    physics: float = 1e-2
    """θ_p, in pre-training and fine-tuning."""
    pretraining: float = 1e-4
    """θ_d, both models."""
    hybrid: tuple[float, ...] = (1e-3, 1e-4, 1e-4, 1e-4, 1e-3)
    """θ_d of the hybrid, fine-tuned and target-only."""
    no_physics: tuple[float, ...] = (1e-4, 1e-4, 1e-4, 1e-4, 1e-5)
    """The network without physics, fine-tuned (the scan of the paper is damaged in the first four)."""
    no_physics_target_only: float = 1e-4
    """The network without physics, from a fresh start."""


@dataclass(frozen=True)
class Stopping:
    """At least `minimum` epochs, then stop after `patience` epochs without a better validation loss."""

    minimum: int
    patience: int


@dataclass(frozen=True)
class Patience:
    """Early stopping; a tuple has one entry for each of the sizes 100, 300, 500, 700, 1000."""

    hybrid_pretraining: Stopping = Stopping(100, 20)
    no_physics_pretraining: Stopping = Stopping(300, 50)
    hybrid_minimum: tuple[int, ...] = (100, 300, 300, 300, 100)
    hybrid_patience: tuple[int, ...] = (20, 50, 50, 50, 20)
    no_physics: Stopping = Stopping(250, 50)


@dataclass(frozen=True)
class Config:
    """Pre-train on source flight, adapt to the target with N short trajectories, test; every seed and size one sweep.

    Without options this is the paper's full protocol. Results are written to --out; flights and finished stages are
    kept in --cache and reused by any run that needs the same ones.
    """

    preset: Literal["paper", "quick", "smoke"] = "paper"
    """paper: the full protocol. quick: two seeds, two sizes, about three minutes. smoke: does everything work."""
    out: Path = Path("runs")
    """Folder for the report, the figures and the models; a folder of the experiment's name is made in it."""
    cache: Path = field(default_factory=lambda: Path(platformdirs.user_cache_dir("hybrid_jax")))
    """Folder for flights, finished stages and compiled programs."""
    seeds: int = 10
    """Trials of each condition: initialisation, order of minibatches, which N trajectories are drawn."""
    sizes: tuple[int, ...] = TABLE_SIZES
    """N, target trajectories to train on; rates and patience are those of the nearest size in the paper's table."""
    models: tuple[Model, ...] = ("hybrid", "no_physics", "physics_only")
    """Which models to compare."""
    source_train: int = 10_000
    """Source trajectories for pre-training."""
    validation: int = 1000
    """Validation trajectories, in the source and in the target."""
    test: int = 1000
    """Target test trajectories of 1 s."""
    data_seed: int = 0
    """Seed of all flights."""
    source_flights: Path | None = None
    """A file of `python -m experiments.make_flights --domain source` to use; by default flights are made and cached."""
    target_flights: Path | None = None
    """The same for the target, with the splits train, validation and test."""
    hidden: int = 64
    """Hidden units of f_d."""
    inputs: Literal["hover", "raw"] = "hover"
    """Rotor speeds as f_d sees them: hover: (u − hover) / (hover / 10); raw: u in rad/s."""
    guess: tuple[float, float] = (0.8, 1.25)
    """θ_p starts at nominal times a random factor in this range."""
    regulariser: RegulariserName = "trajectory_correlation"
    """What keeps f_d from overwriting f_p."""
    regulariser_weight: float = 1e-3
    """λ."""
    solver: Literal["rk4", "heun", "midpoint", "tsit5", "dopri5"] = "rk4"
    """Integrator, one step for each input interval of 0.01 s."""
    batch_size: int = 100
    """Trajectories in a minibatch."""
    max_epochs: int = 2000
    """Cap; a run that hits it is marked in the report."""
    rates: Rates = Rates()
    patience: Patience = Patience()

    def __post_init__(self):
        for name in ("seeds", "source_train", "validation", "test", "hidden", "batch_size", "max_epochs"):
            if getattr(self, name) < 1:
                raise ValueError(f"--{name.replace('_', '-')} must be at least 1, got {getattr(self, name)}")
        if not self.sizes or min(self.sizes) < self.batch_size:
            raise ValueError(f"--sizes must each be at least --batch-size {self.batch_size}, got {self.sizes}")
        if self.source_train < self.batch_size:
            raise ValueError(f"--source-train must be at least --batch-size {self.batch_size}, got {self.source_train}")
        if len(set(self.sizes)) < len(self.sizes) or not self.models or len(set(self.models)) < len(self.models):
            raise ValueError(f"--sizes and --models must each be different, got {self.sizes} and {self.models}")
        if not 0 < self.guess[0] < self.guess[1]:
            raise ValueError(f"--guess must be two factors, low < high, above 0, got {self.guess}")
        for name in ("rates.hybrid", "rates.no_physics", "patience.hybrid_minimum", "patience.hybrid_patience"):
            group, entry = name.split(".")
            if len(getattr(getattr(self, group), entry)) != len(TABLE_SIZES):
                raise ValueError(f"--{name.replace('_', '-')} must have one entry for each of {TABLE_SIZES}")


def column(size: int) -> int:
    """The column of the paper's table that is nearest to a size, by ratio."""
    return min(range(len(TABLE_SIZES)), key=lambda i: max(size / TABLE_SIZES[i], TABLE_SIZES[i] / size))


PAPER = Config()
QUICK = replace(
    PAPER, preset="quick", seeds=2, sizes=(100, 1000), models=("hybrid", "no_physics"), source_train=3000,
    validation=300, test=300, max_epochs=400,
)  # fmt: skip
SMOKE = replace(
    PAPER, preset="smoke", seeds=1, sizes=(20,), source_train=40, validation=20, test=10, batch_size=20, max_epochs=3,
    hidden=8,
)  # fmt: skip
PRESETS = {"paper": PAPER, "quick": QUICK, "smoke": SMOKE}
