"""The options of `python -m experiments.real_flight`, and its presets."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

from experiments.runner.options import Count, Named, Positive, Run, Several, Target
from hybrid_jax.cli.logs import FlightOptions
from hybrid_jax.dynamics.vehicle_file import check_learned

PATHS = ("source", "target", "test", "vehicle", "columns")
OPTIONS = {name: f"--{name}" for name in PATHS} | {"source": "--before", "target": "--after"}


@dataclass(frozen=True)
class RealFlightConfig(FlightOptions, Run):
    """Learn from the flights in --before, adapt to N windows of --after, test on held-out flights.

    Learning, adaptation and log readers are those of `hybrid-jax fit` and `adapt`, so you get the scores of the tool.
    Without --test, the target's flights are held out in turn (--folds). Without --after, nothing is adapted and the
    source's models are tested. No data? Try --simulated.

    Example: python -m experiments.real_flight --vehicle v.toml --before before/ --after after/ --n-target 100,600
    """

    vehicle: Path | None = None
    """TOML file with a table [vehicle] (mass, inertia, rotor positions, …); see docs/howto/vehicle.md."""
    source: Annotated[Path | None, Named(name="before")] = None
    """Folder of the flights before the change, preferably many."""
    target: Annotated[Path | None, Named(name="after")] = None
    """Folder of the few flights after the change."""
    test: Path | None = None
    """Folder of test flights; by default the target's flights are held out in turn."""
    simulated: bool = False
    """Simulate flights, write their logs to --out and use them."""
    learn: tuple[str, ...] = ()
    """Parameters to learn, instead of the vehicle file's."""
    dt: Positive = 0.01
    """Interval of the models [s]."""
    horizon: Several[Count] = (10, 50)
    """Numbers of intervals after which errors are measured."""
    n: Annotated[Several[Count], Target] = (100, 600)
    """Numbers of target windows of ten intervals to adapt to, spread evenly over the training flights."""
    folds: Count = 3
    """Without --test: number of folds, or as many as there are names."""
    folds_by: Literal["flight", "manoeuvre"] = "flight"
    """Test and training share no flight, or no manoeuvre (file name without number).
    With manoeuvre and without --after, flights in --test are held out by manoeuvre as well."""
    data_seed: int = 0
    """Seed of the folds and of simulated flights."""

    def __post_init__(self):
        Run.__post_init__(self)
        _ = self.reading  # topics are checked before anything is read
        check_learned(self.learn)
        if self.simulated and any(getattr(self, name) for name in PATHS):
            raise ValueError(f"--simulated makes its own logs: leave out {', '.join(OPTIONS.values())}")

    def described(self) -> dict[str, Any]:
        """Return all inputs of the results; folders and files by name only, since flights are described by content."""
        options = Run.described(self)
        return options | {name: None if options[name] is None else options[name].name for name in PATHS}


PAPER = RealFlightConfig(seeds=3)
QUICK = replace(PAPER, preset="quick", seeds=1, n=(100,), folds=2)
SMOKE = replace(PAPER, preset="smoke", seeds=1, n=(20,), horizon=(5, 10), folds=2)
PRESETS = {"paper": PAPER, "quick": QUICK, "smoke": SMOKE}
