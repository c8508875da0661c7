"""The cache of experiments: each finished stage's result in one archive, found by its inputs."""

import hashlib
import re
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from experiments.runner.run_record import backup_path
from hybrid_jax.dynamics.base import AbstractVectorField
from hybrid_jax.io.datasets import Dataset, content_hash, versions
from hybrid_jax.io.files import Arrays, digest, json_value, load_archive, named_leaves, save_archive
from hybrid_jax.io.structure import Structure
from hybrid_jax.training.fitting import FitState, RunConfig
from hybrid_jax.training.objective import Settings, TrajectoryLoss

FORMAT = "hybrid_jax stage 1"
RECIPE = 1  # increment when the same start, plan and data no longer give the same sweep
FINISHED_BY = ("jax", "hybrid_jax")


@dataclass(frozen=True)
class Cache:
    """A folder of finished stages; with `fresh`, results of other versions, and unfinished ones, are moved aside."""

    folder: Path
    say: Callable[[str], None]
    fresh: bool = False

    def path(self, name: str, identity: str) -> Path:
        """Return the archive of a stage, which may not exist; `identity` is of `identity_of` or `sweep_identity`."""
        return self.folder / f"{_stem(name)}-{identity[:16]}.npz"

    def knows(self, name: str) -> bool:
        return any(self.folder.glob(f"{_stem(name)}-*"))

    def load(self, path: Path) -> tuple[Any, Arrays] | None:
        """Return a finished stage's result; ValueError that names the file if it is damaged."""
        if not path.exists():
            return None
        about, arrays = load_archive(path, FORMAT)
        if self.fresh and about["versions"] != versions(*FINISHED_BY):
            return self.move_aside(path)
        return about, arrays

    def save(self, path: Path, about: dict[str, Any], arrays: Arrays) -> None:
        """Save a result: JSON values, of which "seconds" is its time, and arrays."""
        path.parent.mkdir(parents=True, exist_ok=True)
        save_archive(path, FORMAT, about | {"versions": versions(*FINISHED_BY)}, arrays)

    def move_aside(self, path: Path) -> None:
        self.say(f"{path}: moved aside to {path.rename(backup_path(path, 'before')).name}")


def identity_of(*inputs: Any) -> str:
    """Return a stage's identity: JSON, datasets and fields, and the code of these packages, so that any edit counts."""
    sources = [source_digest(package) for package in ("hybrid_jax", "experiments")]
    fixed: list[Any] = [*sources, versions(*FINISHED_BY)]
    arrays: dict[str, Any] = {}
    for value in inputs:
        match value:
            case AbstractVectorField():
                fixed.append(Structure(value).tree)
                arrays |= {f"{len(fixed)}.{name}": leaf for name, leaf in named_leaves(value).items()}
            case Dataset():
                fixed.append(content_hash(value))
            case _:
                fixed.append(json_value(value))
    return digest(fixed, arrays)


def sweep_identity(states: FitState, plans: RunConfig, settings: Settings, data: Dataset) -> str:
    """Return a sweep's identity without the code: training is too slow to be repeated after every edit; see RECIPE."""
    regulariser = None if settings.regulariser is None else settings.regulariser.__name__
    shared = [settings.batch_size, regulariser, type(settings.solver).__name__]
    objective: Any = settings.objective
    if not isinstance(objective, TrajectoryLoss):
        shared += [type(objective).__name__, asdict(objective)]
    # Array leaves do not include a field's static data, such as the vehicle or the scaling of inputs.
    fixed = [RECIPE, *shared, Structure(states.field).tree, content_hash(data)]
    return digest(fixed, named_leaves({"start": states, "plan": plans}))


@cache
def source_digest(package: str) -> str:
    spec = find_spec(package)
    digest = hashlib.sha256()
    for root in sorted(spec.submodule_search_locations or ()) if spec else ():
        for path in sorted(Path(root).rglob("*.py")):
            digest.update(f"{path.relative_to(root)}\n".encode() + path.read_bytes())
    return digest.hexdigest()


def _stem(name: str) -> str:
    return re.sub(r"[^\w.,=-]+", "-", name)  # as a file may be called anywhere
