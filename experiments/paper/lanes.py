"""Trained and tested models, and their rows in the table of results."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

import hybrid_jax
from experiments.reporting import names
from experiments.reporting.names import HYBRID, SOURCE_ONLY, label
from experiments.reporting.results import Results, Row
from hybrid_jax.dynamics import AbstractVectorField, Hybrid
from hybrid_jax.sim.flight import DT
from hybrid_jax.status import Status
from hybrid_jax.sweep.lanes import lane
from hybrid_jax.training.fitting import FitState
from hybrid_jax.trajectories import Trajectories

THETA = ("Ix", "Iy", "k")
DOMAINS = (names.PARAMETER_SHIFT, names.EXTERNAL_FORCE)
BASELINES = (
    names.EXPERT_AUGMENTATION, names.THETA_P_ONLY, names.THETA_D_ONLY, names.LAST_LAYER, names.LEAST_SQUARES,
    names.CONSTANT_DISTURBANCE, names.LINEAR_RESIDUAL,
)  # fmt: skip
MODELS = (HYBRID, names.NO_PHYSICS, names.PHYSICS_ONLY, *BASELINES)
MODES = (names.FINE_TUNED, names.TARGET_ONLY, SOURCE_ONLY)
# Test windows by their lowest altitude [m]: near the ground, above it, and where no ground effect is left.
BANDS = {"low": "below 0.12 m", "middle": "0.12–0.5 m", "high": "above 0.5 m"}
BAND_EDGES = (0.12, 0.5)
CELL = ("model", "mode", "n_train")
TAGS = ("domain", *CELL, "draw", "seed")
Cell = tuple[str, str, int]  # model, mode, n_train


class Fit(NamedTuple):
    """Models after training, or adapted in closed form: stacked, one for each size and seed."""

    fields: Any
    val_mse: Any
    epochs: Any
    status: Any


@dataclass(frozen=True)
class Lanes:
    """The tested models of one kind in one mode, stacked, and each one's row in the table of results."""

    model: str
    mode: str
    fields: Any
    rows: Sequence[Row]


def fit_of(final: FitState) -> Fit:
    return Fit(final.best, final.best_mse, final.epoch, final.status)


def lanes_of(
    domain: str,
    model: str,
    mode: str,
    sizes: Sequence[int],
    seeds: int,
    fit: Fit,
    errors: np.ndarray,
    theta: Mapping[str, np.ndarray] | None = None,
    more: Mapping[str, np.ndarray] | None = None,
) -> Lanes:
    """Return models tested in a domain, one for each size, draw and seed; `theta` replaces the models' own."""
    theta, runs = theta_of(fit.fields) if theta is None else theta, len(errors) // len(sizes)

    def row(i: int) -> Row:
        return {
            "domain": domain,
            "model": model,
            "mode": mode,
            "n_train": sizes[i // runs],
            "draw": i % runs // seeds,
            "seed": i % seeds,
            "test_mse": float(errors[i]),
            "rho": None,  # see `with_rho`
            "val_mse": float(fit.val_mse[i]),
            "epochs": int(fit.epochs[i]),
            "status": str(Status(int(fit.status[i]))),
            "theta": {name: float(value[i]) for name, value in theta.items()} or None,
            **{name: float(values[i]) for name, values in (more or {}).items()},
        }

    return Lanes(model, mode, fit.fields, [row(i) for i in range(len(errors))])


def by_altitude(
    column: str, windows: Trajectories, errors: Float[np.ndarray, "lanes windows"]
) -> dict[str, Float[np.ndarray, " lanes"]]:
    """Average each model's error over the windows of each band, by column; NaN for a band without windows."""
    band = bands(windows)
    with np.errstate(invalid="ignore", divide="ignore"):
        sums = [errors[:, band == i].sum(axis=1) / np.float64(np.sum(band == i)) for i in range(len(BANDS))]
    return {f"{column}_{name}": mean for name, mean in zip(BANDS, sums, strict=True)}


def bands(windows: Trajectories) -> Int[np.ndarray, " windows"]:
    """Return the index in BANDS of the lowest altitude of each window."""
    return np.digitize(np.minimum(windows.x0[:, 2], windows.x[..., 2].min(axis=1)), BAND_EDGES)


def physics_in(field: Any) -> Any:
    """Return the physics inside a field, also of nested hybrids."""
    return physics_in(field.physics) if isinstance(field, Hybrid) else field


def theta_of(field: AbstractVectorField) -> Mapping[str, np.ndarray]:
    return {name: np.asarray(value) for name, value in getattr(physics_in(field), "theta", dict)().items()}


def rows_of(groups: Sequence[Lanes]) -> Results:
    return with_rho(Results([row for lanes in groups for row in lanes.rows], TAGS))


def with_rho(rows: Results) -> Results:
    """Add ρ = (L^S − L^T) / L^S (paper, Eq. 9), L^S the same seed's source-only error; see `source_of`."""
    source = {(row["domain"], row["model"], row["seed"]): row["test_mse"] for row in rows.where(mode=SOURCE_ONLY)}

    def rho(row: Row) -> float | None:
        key = row["domain"], source_of(row["model"]), row["seed"]
        if source.get(key, 0) == 0:
            lack = "a source_only row has test_mse 0:" if key in source else "no source_only row of"
            raise ValueError(f"{lack} {key[1]}, seed {key[2]}, in {key[0]}: ρ is not defined")
        before, after = source[key], row["test_mse"]
        return None if before is None or after is None else (before - after) / before

    return Results([{**row, "rho": rho(row)} for row in rows], rows.tags)


def source_of(model: str) -> str:
    """Return the model whose pre-training an adaptation starts from."""
    return HYBRID if model in BASELINES else model


def gain(row: Row) -> float:
    """Return ρ for a mean: −∞ if the test error is not finite; 1 if only the source-only error is not finite."""
    if row["rho"] is not None:
        return row["rho"]
    return -math.inf if row["test_mse"] is None else 1.0


def cells(rows: Results) -> dict[Cell, Results]:
    if len(domains := sorted(rows.unique("domain"))) > 1:
        raise ValueError(f"rows must be of one domain, got {', '.join(domains)}")
    return rows.sort(model=MODELS, mode=MODES, n_train=None).group(*CELL)


def by_domain(rows: Results) -> dict[str, Results]:
    return rows.sort(domain=DOMAINS).group("domain")


def adapted_sizes(rows: Results) -> list[int]:
    return sorted({*rows["n_train"]} - {0})


def ranked(rows: Results) -> dict[Cell, Results]:
    """Return `cells`, the smallest mean error first; among infinite means the smallest error first."""

    def error(item: tuple[Cell, Results]) -> tuple[float, float]:
        values = item[1].spread("test_mse")
        return values.mean, values.smallest

    return dict(sorted(cells(rows).items(), key=error))


def method_label(cell: Cell) -> str:
    """Label a cell as a method for readers, without N, and without the mode if that is clear."""
    model, mode, _ = cell
    plain = mode == names.FINE_TUNED or (mode == SOURCE_ONLY and model in BASELINES)
    return label(model) if plain else label(model, mode)


def save_models(folder: Path, groups: Sequence[Lanes], rows: Results) -> None:
    """Save every trained model with its row, in the order of `rows_of`."""
    models = [lane(lanes.fields, i) for lanes in groups for i in range(len(lanes.rows))]
    for model, row in zip(models, rows, strict=True):
        about = {name: row[name] for name in ("model", "mode", "n_train", "draw", "seed", "test_mse", "val_mse")}
        name = "{model}-{mode}-{n_train}-seed{seed}" + ("-draw{draw}" if row["draw"] else "")
        path = folder / f"{name.format(**row)}.npz"
        hybrid_jax.save(path, model, about | {"dt": DT})
