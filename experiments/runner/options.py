"""Command-line options shared by all experiments."""

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, is_dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar, get_args, get_type_hints

import platformdirs
import tyro

from hybrid_jax import checks
from hybrid_jax.cli.help import option_of
from hybrid_jax.networks.mlp import ACTIVATIONS

Value = TypeVar("Value")


def distinct(option: str, names: Sequence[Any], least: int = 1) -> None:
    """Raise ValueError if an option lists too little, or something twice."""
    if len(names) < least or len(set(names)) < len(names):
        raise ValueError(f"{option} must be at least one, each different, got {tuple(names)}")


Named = tyro.conf.arg
Target = Named(name="n-target")  # N, the same option of all commands
# Types with a rule, which `check_rules` applies wherever an option's type mentions them.
Count = Annotated[int, checks.count]
CountFromZero = Annotated[int, partial(checks.count, least=0)]
Positive = Annotated[float, checks.positive]
NotNegative = Annotated[float, checks.not_negative]
Several = Annotated[tuple[Value, ...], distinct]
if TYPE_CHECKING:
    Activation = str
else:  # the command line offers what the registry holds
    Activation = Literal[tuple(ACTIVATIONS)]

# Options that --help lists; --help-all lists all.
COMMON = {"preset", "out", "fresh", "seeds", "sizes", "models", "methods", "changes", "compared", "references"}
COMMON |= {"agents", "over", "parts", "change", "parameters", "noise", "seconds", "worlds"}
COMMON |= {"vehicle", "source", "target", "simulated", "learn", "columns", "n", "folds"}
# Options that do not affect the results.
UNFIXED = ("out", "cache", "fresh", "saving", "distributed", "coordinator", "processes", "process_id", "timeout")


@dataclass(frozen=True)
class Run:
    """Results are written to --out. Flights and finished stages are kept in --cache and reused by later runs."""

    preset: Literal["paper", "quick", "smoke"] = "paper"
    """How much to run. paper: all. quick: less. smoke: a check that the program works; its numbers mean nothing."""
    out: Path = Path("runs")
    """Folder of reports, in which one named after the experiment is created."""
    cache: Path = field(default_factory=lambda: Path(platformdirs.user_cache_dir("hybrid_jax")))
    """Folder for flights and finished stages. Compiled programs are kept in the user's cache folder, or in
    JAX_COMPILATION_CACHE_DIR."""
    fresh: Annotated[bool, Named(name="restart")] = False
    """Start again, with earlier results in --out and unfinished sweeps moved to a backup. Nothing is deleted."""
    saving: Annotated[float, Named(name="checkpoint-share")] = 0.02
    """Largest share of a sweep's time for checkpoints; with a smaller share you lose more work if the run is killed."""
    seeds: Count = 10
    """Trials of each condition. Seeds differ in initialisation, order of minibatches, and the N trajectories."""
    distributed: bool = False
    """Share the runs between processes, on one machine or many: start the same command for each.
    Process 0 writes. Slurm, Open MPI, Kubernetes and Cloud TPU are detected; elsewhere set the next three options."""
    coordinator: str | None = None
    """With --distributed: host:port of process 0; the port must be free there and reachable by all processes."""
    processes: int | None = None
    """With --distributed: the number of processes."""
    process_id: int | None = None
    """With --distributed: the index of this process, from 0."""
    timeout: Positive = 120.0
    """With --coordinator: seconds without an answer after which a process counts as lost."""

    def __post_init__(self):
        if not self.distributed and (self.coordinator, self.processes, self.process_id) != (None, None, None):
            raise ValueError("--coordinator, --processes and --process-id need --distributed")
        if not 0 < self.saving <= 1:
            raise ValueError(f"--checkpoint-share must be above 0 and at most 1, got {self.saving}")
        check_rules("--", self)

    def described(self) -> dict[str, Any]:
        return {name: value for name, value in asdict(self).items() if name not in UNFIXED}


def check_rules(prefix: str, options: Any) -> None:
    """Apply to every option of a dataclass the rules of its type, such as `Count` or `tuple[Positive, ...] | None`."""
    for name, hint in get_type_hints(type(options), include_extras=True).items():
        own, value = getattr(hint, "__metadata__", ()), getattr(options, name)
        option = f"{prefix}{option_of(name, own)}"
        if is_dataclass(value):
            check_rules(f"{option}.", value)
        if value is None or isinstance(value, str):  # a word that stands for a number
            continue
        for rule in filter(callable, own):
            rule(option, value)
        for rule in (rule for part in get_args(hint) for rule in _rules(part)):
            for entry in value if isinstance(value, tuple) else (value,):
                rule(option, entry)


def _rules(hint: Any) -> list[Any]:
    own = [rule for rule in getattr(hint, "__metadata__", ()) if callable(rule)]
    return own + [rule for part in get_args(hint) for rule in _rules(part)]


def factors(option: str, value: tuple[float, float]) -> None:
    """Raise ValueError unless an option is two finite factors above 0, the lower one first."""
    if not 0 < value[0] < value[1] < math.inf:
        raise ValueError(f"{option} must be two factors, low < high, above 0, got {value}")
