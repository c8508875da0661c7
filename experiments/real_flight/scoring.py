"""Test models on held-out flights: a row for each model tested in one fold, and hypotheses.

Columns besides TAGS: recipe (empty for a baseline), val_loss, epochs, status of the training; windows, how many were
tested; scores: "10", "50", … (RMSE after so many intervals) and "sum" → quantity → error; theta: θ_p by name in SI
units; theta_interval: their 95 % intervals [low, high]. Both are None where there are none.
"""

from collections.abc import Callable, Mapping, Sequence
from itertools import groupby, product
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from experiments.real_flight.config import NANODRONE_STEPS, RealFlightConfig
from experiments.real_flight.folds import non_overlapping
from experiments.real_flight.models import body_of
from experiments.real_flight.train import TrainedModel, TrainingData
from experiments.reporting import names
from experiments.reporting.claims import Claim, Part, Undecided, Verdict, evaluate, every
from experiments.reporting.results import Results
from experiments.reporting.statistics import Interval, mean_interval
from hybrid_jax.adaptation.ridge import fit_ridge, linear_residual
from hybrid_jax.dynamics.base import AbstractVectorField
from hybrid_jax.dynamics.composition import Hybrid
from hybrid_jax.estimation.least_squares import ravel_parameters
from hybrid_jax.estimation.uncertainty import covariance_of, intervals
from hybrid_jax.flights.scores import FlightErrors, flight_errors
from hybrid_jax.status import Status
from hybrid_jax.sweep.lanes import lane, stack
from hybrid_jax.training.channels import ChannelLoss
from hybrid_jax.training.stages import cut
from hybrid_jax.trajectories import Trajectories

QUANTITIES = {"position": "m", "velocity": "m/s", "rotation": "rad", "body_rates": "rad/s"}
BASELINES = (names.LINEAR_RESIDUAL, names.THRUST, names.HOLD)
MODELS = (names.CHOSEN, names.HYBRID, names.NO_PHYSICS, names.PHYSICS_ONLY, *BASELINES)
MODES = (names.FINE_TUNED, names.SCRATCH, names.ZERO_SHOT, names.SOURCE_ONLY, names.NOMINAL)
TAGS = ("fold", "model", "mode", "n_train", "seed")
OWN_LABELS = {names.LINEAR_RESIDUAL: "rigid body + linear residual", names.SOURCE_ONLY: "trained", names.NOMINAL: ""}
SUM = "sum"  # label of the nanodrone protocol's score; other labels are numbers of intervals
INTERVAL_STEPS = 10  # length of the windows that intervals of θ_p come from: short, so that many are independent
ROUND = 25  # their number is a multiple of it

Cell = tuple[str, str, int]  # model, mode, n_train
Cells = Mapping[Cell, Results]
Replicates = Sequence[tuple[str, Bool[np.ndarray, " n"]]]  # test flights, or manoeuvres, and which windows are theirs


class Test(NamedTuple):
    """A model tested in one fold."""

    row: dict[str, Any]
    errors: Float[np.ndarray, "2 4 t"]  # at every step: RMS and mean over windows
    replicates: list[dict[str, Any]]  # a row with the scores of each


def score(
    field: AbstractVectorField,
    *,
    windows: Trajectories,
    replicates: Replicates,
    config: RealFlightConfig,
    fold: str,
    **columns: Any,
) -> Test:
    """Test a field; `columns` are further columns of the row."""
    errors = flight_errors(field, windows)
    rms, mean = by_step(errors)
    row = {"fold": fold, "model": "", "mode": "", "n_train": 0, "seed": 0, "recipe": "", "windows": len(windows)}
    row |= {"val_loss": None, "epochs": 0, "status": "ok", "scores": scores(rms, mean, config)}
    row |= {"theta": None, "theta_interval": None} | columns
    of_each = [
        {"replicate": name}
        | {tag: row[tag] for tag in TAGS}
        | {"scores": scores(*by_step(FlightErrors(*(part[own] for part in errors))), config)}
        for name, own in replicates
    ]
    return Test(row, np.stack([rms, mean]), of_each)


def by_step(errors: FlightErrors) -> tuple[np.ndarray, np.ndarray]:
    """RMS and mean of the errors over the windows, (4, t) each."""
    rms = [np.sqrt(np.mean(np.square(part, dtype=float), axis=0)) for part in errors]
    return np.array(rms), np.array([np.mean(part, axis=0, dtype=float) for part in errors])


def scores(rms: np.ndarray, mean: np.ndarray, config: RealFlightConfig) -> Mapping[str, Mapping[str, float]]:
    """Pick the RMSE at each horizon and, with the nanodrone protocol, the mean errors of 50 steps, summed."""
    found = {str(steps): rms[:, steps - 1] for steps in config.horizon}
    if config.protocol == "nanodrone":
        found[SUM] = mean[:, :NANODRONE_STEPS].sum(axis=1)
    return {label: dict(zip(QUANTITIES, values, strict=True)) for label, values in found.items()}


def score_model(scoring: Callable[..., Test], trained: TrainedModel, theta: Sequence[Mapping[str, Any]]):
    """Test all runs of a model by `score` with a fold's arguments; `theta` is what `parameters` found."""
    for run in range(len(trained)):
        columns = {"model": trained.model, "mode": trained.mode, "recipe": trained.recipe, **theta[run]}
        columns |= {"n_train": trained.size(run), "seed": trained.seeds[run], "epochs": int(trained.epochs[run])}
        status = str(Status(int(trained.status[run])))
        yield scoring(trained.run(run), **columns, val_loss=trained.val_loss[run], status=status)


def parameters(trained: TrainedModel, data: TrainingData) -> list[dict[str, Any]]:
    """Estimate θ_p of each run, and its intervals if enough of its training windows share no sample."""
    if body_of(trained.fields) is None:
        return [{} for _ in trained.seeds]
    short, found = _short(data), []
    spacing, learned = -(-short.horizon // data.train.stride), ravel_parameters(trained.run(0))[0].size
    # Runs of one size share a program; rounding the number of windows lets sizes and folds share one too.
    for _, group in groupby(range(len(trained)), lambda run: len(trained.subsets[run])):
        runs = list(group)
        own = [non_overlapping(trained.subsets[run], data.train.sizes, spacing) for run in runs]
        most = min(map(len, own)) // ROUND * ROUND
        picked = stack([each[np.linspace(0, len(each) - 1, most).round().astype(int)] for each in own])
        of, bounded = lane(trained.fields, np.array(runs)), most > learned
        ends = jax.device_get(_intervals(of, picked if bounded else picked[:, :0], short, data.objective))
        for run in range(len(runs)):
            theta = {name: at.value[run] for name, at in ends.items()}
            around = {name: [at.low[run], at.high[run]] for name, at in ends.items()}
            found.append({"theta": theta, "theta_interval": around if bounded else None})
    return found


@eqx.filter_jit
def _intervals(fields: Any, picked: Int[np.ndarray, "runs n"], windows: Trajectories, objective: ChannelLoss):
    """θ_p of each run and its intervals, of no width without windows."""

    def one(run):
        (field, indices), body = run, body_of(run[0])
        if len(indices):
            return intervals(body, covariance_of(field, windows[indices], error=objective.error))
        return intervals(body, jnp.zeros((ravel_parameters(body)[0].size,) * 2))

    return jax.lax.map(one, (fields, picked))


def linear_residuals(base: Any, data: TrainingData, subsets: Sequence[np.ndarray], test_base: Any) -> list[Hybrid]:
    """Fit a linear residual of `base` to each subset of the training windows, of one size; add it to `test_base`."""
    fitted = jax.device_get(_linear_residuals(base, _short(data), stack(subsets), data.validation))
    return [Hybrid(test_base, lane(fitted, run).residual) for run in range(len(subsets))]


@eqx.filter_jit
def _linear_residuals(base, windows: Trajectories, subsets: Int[np.ndarray, "runs n"], validation: Trajectories):
    return jax.lax.map(lambda subset: fit_ridge(linear_residual, base, windows[subset], validation).field, subsets)


def _short(data: TrainingData) -> Trajectories:
    return cut(data.train.windows, min(INTERVAL_STEPS, data.train.windows.horizon))


def relative_error(errors: FlightErrors, baseline: FlightErrors, horizons: Sequence[int]) -> float:
    """Average RMSE over that of a baseline, over quantities and horizons; the rotors' lag is chosen by it."""
    ends = [[part[:, steps - 1] for part in found for steps in horizons] for found in (errors, baseline)]
    own, other = ([np.sqrt(np.mean(np.square(end, dtype=float))) for end in each] for each in ends)
    return float(np.mean(np.divide(own, other)))


def labels(config: RealFlightConfig) -> list[str]:
    """The labels of the scores of a run."""
    return [*map(str, config.horizon), *[SUM] * (config.protocol == "nanodrone")]


def cells(rows: Results) -> dict[Cell, Results]:
    """Group rows over folds and seeds, in the order of MODELS, MODES and n_train."""
    return rows.sort(model=MODELS, mode=MODES, n_train=None, seed=None).group("model", "mode", "n_train")


def cell_name(model: str, mode: str, n_train: int = 0) -> str:
    """Label a model, what was done with it, and with how many windows."""
    words = [(names.LABELS | OWN_LABELS).get(key, key) for key in (model, mode)]
    return ", ".join(filter(None, [*words, f"N = {n_train}" if n_train else ""]))


def score_labels(rows: Results) -> list[str]:
    """The labels of the scores, such as "10" and "sum"."""
    return list(rows[0]["scores"])


def pooled(rows: Results, label: str, quantity: str) -> np.ndarray:
    """Compute the error of each seed over the test windows of all folds together."""
    power = 1 if label == SUM else 2  # means are averaged as they are, root mean squares as squares

    def one(own: Results) -> float:
        weights, errors = own.numbers("windows"), own.numbers(f"scores.{label}.{quantity}")
        return float((weights @ errors**power / weights.sum()) ** (1 / power))

    return np.array([one(own) for own in rows.sort(seed=None).group("seed").values()])


def verdicts(rows: Results) -> list[Verdict]:
    """Evaluate each hypothesis that the rows of replicates can answer."""
    found = cells(rows)
    sizes = sorted({n for _, _, n in found} - {0})
    mode, most = ("fine_tuned", sizes[-1]) if sizes else ("source_only", 0)
    best = ("hybrid", mode, most)
    if best not in found:
        return []
    baselines = [cell for cell in found if cell[0] in BASELINES]
    rivals = [(model, mode, most) for model in ("no_physics", "physics_only")]
    claims = [
        _better("F1", best, baselines, "every simple baseline"),
        _better("F2", best, rivals, "no-physics and physics-only"),
    ]
    if sizes:
        few, scratch = (("hybrid", mode, sizes[0]) for mode in ("fine_tuned", "scratch"))
        claims += [
            _better("F3", few, [scratch], "the same model from scratch"),
            _better("F4", few, [("hybrid", "zero_shot", 0)], "the source's model as it is"),
        ]
    return evaluate(claims, found)


def _better(name: str, cell: Cell, others: Sequence[Cell], of: str) -> Claim[Cells]:
    """Claim that a cell has a smaller error than each of the others, in every quantity and at every horizon."""

    def predicate(found: Cells) -> Part:
        known = [found[other] for other in others if other in found]
        if not known:
            raise Undecided("none of these was run")
        outcomes, words = [], []
        for label, quantity in product(score_labels(found[cell]), QUANTITIES):
            ratios = [_log_ratio(found[cell], rows, f"scores.{label}.{quantity}") for rows in known]
            outcomes += [ratio.below(0.0) for ratio in ratios]
            worst = Interval(*np.exp(max(ratios, key=lambda ratio: ratio.value)))
            words.append(f"{'summed' if label == SUM else f'step {label}'} {quantity} {worst.text('.3f')}")
        return every(outcomes), f"error over that of the best of them: {', '.join(words)}"

    text = f"{cell_name(*cell)}, has smaller errors than {of} in every quantity"
    return Claim(name, f"{text} (95 % interval of the geometric mean ratio, over test flights and seeds).", predicate)


def _log_ratio(rows: Results, others: Results, column: str) -> Interval:
    """log(error / other error), of the same replicate and seed; a baseline, without seeds, of the same replicate."""
    theirs = {(row["replicate"], row["seed"]): error for row, error in zip(others, others.numbers(column), strict=True)}
    pairs = [(row["replicate"], row["seed"] if len(others.unique("seed")) > 1 else others[0]["seed"]) for row in rows]
    with np.errstate(all="ignore"):
        ratios = np.log(rows.numbers(column) / np.array([theirs[pair] for pair in pairs]))
    return mean_interval(ratios, rows["seed"], rows["replicate"])
