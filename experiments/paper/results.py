"""Trained lanes of one model, tested: the rows that they make in a report, and their files."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import hybrid_jax
from experiments.paper.rows import Row
from experiments.paper.solved import Solved
from hybrid_jax.dynamics.base import AbstractVectorField, Hybrid
from hybrid_jax.sim.flight import DT
from hybrid_jax.sweep.lanes import lane
from hybrid_jax.training.fitting import STATUS_NAMES, STOPPED, FitState


@dataclass(frozen=True)
class Lanes:
    """The trained lanes of one model in one mode, one for each size and seed.

    Attributes:
        sizes, seeds: of each lane.
        fields: the trained models, stacked.
        errors: L^T_MSE of each on the test flights.
        val_mse: L_MSE of each on the validation windows.
        epochs, status: of its training; see `training`.
        theta: Ix, Iy, k of each; None for models without physics.
        intervals: name → (lanes, 2), low and high end of the 95 % interval; None where there are none.
    """

    model: str
    mode: str
    sizes: Sequence[int]
    seeds: Sequence[int]
    fields: Any
    errors: np.ndarray
    val_mse: np.ndarray
    epochs: np.ndarray
    status: np.ndarray
    theta: Mapping[str, np.ndarray] | None
    intervals: Mapping[str, np.ndarray] | None = None

    def field(self, index: int) -> AbstractVectorField:
        """The model of one lane."""
        return lane(self.fields, index)


def trained(
    model: str, mode: str, sizes: Sequence[int], seeds: Sequence[int], final: FitState, errors: np.ndarray
) -> Lanes:
    """The lanes of a sweep, tested as the best of their final states."""
    fit = (np.asarray(leaf) for leaf in (final.best_mse, final.epoch, final.status))
    return Lanes(model, mode, sizes, seeds, final.best, errors, *fit, theta=theta_of(final.best))


def solution(model: str, sizes: Sequence[int], seeds: Sequence[int], found: Solved, errors: np.ndarray) -> Lanes:
    """The lanes of a model that was solved instead of trained, tested."""
    return Lanes(model, "fine_tuned", sizes, seeds, found.fields, errors, *found[1:], theta=theta_of(found.fields))


def physics_in(field: Any) -> Any:
    """The physics inside a field, hybrids of hybrids included."""
    return physics_in(field.physics) if isinstance(field, Hybrid) else field


def theta_of(field: AbstractVectorField) -> Mapping[str, np.ndarray] | None:
    """θ_p of a model that has physics, or of stacked ones."""
    theta = getattr(physics_in(field), "theta", None)
    return None if theta is None else {name: np.asarray(value) for name, value in theta().items()}


def rows_of(lanes: Lanes, domain: str) -> list[Row]:
    """A row for each lane, tested in the domain of this name; ρ still open."""
    return [
        Row(
            domain=domain,
            model=lanes.model,
            mode=lanes.mode,
            n_train=int(size),
            seed=int(seed),
            test_mse=float(lanes.errors[i]),
            rho=None,
            val_mse=float(lanes.val_mse[i]),
            epochs=int(lanes.epochs[i]),
            status=STATUS_NAMES.get(int(lanes.status[i]), STATUS_NAMES[STOPPED]),
            theta=_at(lanes.theta, i, float),
            theta_interval=_at(lanes.intervals, i, lambda ends: [float(end) for end in ends]),
        )
        for i, (size, seed) in enumerate(zip(lanes.sizes, lanes.seeds, strict=True))
    ]


def save_models(folder: Path, lanes: Sequence[Lanes], rows: Sequence[Row]) -> None:
    """Every trained model, by name; rows hold what is known about it."""
    by_key = {(row.model, row.mode, row.n_train, row.seed): row for row in rows}
    for group in lanes:
        for i, (size, seed) in enumerate(zip(group.sizes, group.seeds, strict=True)):
            row = by_key[group.model, group.mode, size, seed]
            about = {"model": row.model, "mode": row.mode, "n_train": row.n_train, "seed": row.seed}
            about |= {"test_mse": row.test_mse, "val_mse": row.val_mse, "dt": DT}
            name = f"{row.model}-{row.mode}-{row.n_train}-seed{row.seed}.npz"
            hybrid_jax.save(folder / name, group.field(i), about)


def _at(values: Mapping[str, np.ndarray] | None, index: int, read) -> dict[str, Any] | None:
    return None if values is None else {name: read(value[index]) for name, value in values.items()}
