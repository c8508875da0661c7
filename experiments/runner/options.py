"""Command-line options shared by all experiments."""

from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

import platformdirs

# Options that do not affect the results.
UNFIXED = ("out", "cache", "fresh", "saving", "distributed", "coordinator", "processes", "process_id")


@dataclass(frozen=True)
class Run:
    """Results are written to --out. Flights and finished stages are kept in --cache and reused by later runs."""

    preset: Literal["paper", "quick", "smoke"] = "paper"
    """paper: the full protocol. quick: two seeds, two sizes, about three minutes. smoke: a functional check."""
    out: Path = Path("runs")
    """Folder for the report, the figures and the models; a subfolder named after the experiment is created in it."""
    cache: Path = field(default_factory=lambda: Path(platformdirs.user_cache_dir("hybrid_jax")))
    """Folder for flights, finished stages and compiled programs."""
    fresh: bool = False
    """Start anew: earlier results in --out and unfinished sweeps are moved to a backup; nothing is deleted."""
    saving: float = 0.02
    """Largest share of a sweep's time spent on saving checkpoints; a smaller share means more work lost by a kill."""
    seeds: int = 10
    """Trials of each condition: initialisation, order of minibatches, which N trajectories are drawn."""
    distributed: bool = False
    """Be one of several processes, on one machine or many, that share the runs: start the same command for each.
    Process 0 writes. Slurm, Open MPI, Kubernetes and Cloud TPU are detected; elsewhere set the next three options."""
    coordinator: str | None = None
    """With --distributed: host:port of process 0; the port must be free there and reachable by all processes."""
    processes: int | None = None
    """With --distributed: the number of processes."""
    process_id: int | None = None
    """With --distributed: the index of this process, from 0."""

    def __post_init__(self):
        if not self.distributed and (self.coordinator, self.processes, self.process_id) != (None, None, None):
            raise ValueError("--coordinator, --processes and --process-id need --distributed")
        if self.seeds < 1:
            raise ValueError(f"--seeds must be at least 1, got {self.seeds}")
        if not 0 < self.saving <= 1:
            raise ValueError(f"--saving must be a share above 0 and at most 1, got {self.saving}")

    def described(self) -> dict[str, Any]:
        """The options that determine the results."""
        return {name: value for name, value in asdict(self).items() if name not in UNFIXED}
