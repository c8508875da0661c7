"""The second study: adapt to changed equations from a few trajectories, as in the paper's Figs. 3 and 5."""

import warnings
from functools import cache, partial
from itertools import product
from typing import Any

import jax

import hybrid_jax as hj
from experiments.reaction_diffusion.config import Config
from experiments.reaction_diffusion.forecast import GUESS, scaling
from experiments.reaction_diffusion.models import error, pieces, weights, with_weights
from experiments.reaction_diffusion.systems import COARSE, A, B, K, fitzhugh_nagumo, plane, reacting
from experiments.reporting.names import FINE_TUNED, HYBRID, LEAST_SQUARES, NO_PHYSICS, SOURCE_ONLY, TARGET_ONLY
from experiments.reporting.results import Row
from experiments.runner.stages import Found, Kept, rows_of
from hybrid_jax.adaptation import Adaptation
from hybrid_jax.trajectories import concatenate

PART, AUTO = "shifted", "auto"
SOURCE, TARGET, TEST = 20, 21, 22  # first numbers of the seeds of data
SHIFTS = {"parameter_shift": (2 * A, B / 2, 2 * K, 0.0), "new_term": (A, B, K, -0.5)}
SOURCES = 2  # trajectories that a source learns from
EVERY = 12  # intervals between the windows to learn from
TUNING, SCRATCH = 6, 14  # most Gauss–Newton steps from the source, and from random weights
WINDOW = 3  # intervals of a window to adapt parameters to
SHARE = 3  # test trajectories: --n-test over this
MODELS = {HYBRID: 1, NO_PHYSICS: 3}  # kernel of the network


def untrained(model: str, config: Config, seed: int) -> hj.AbstractVectorField:
    grid, kernel = plane(config.points), MODELS[model]
    key = jax.random.key(100 + seed)
    hidden = config.units if kernel == 1 else config.channels
    network = hj.grid_network(grid, 0, key, kernel=kernel, hidden=hidden, scaling=scaling(kernel))
    return network if model == NO_PHYSICS else hj.Hybrid(hj.diffusion(grid, GUESS), network)


def learned(field, data: hj.Trajectories, steps: int) -> hj.AbstractVectorField:
    return hj.fit_gauss_newton(field, pieces(data, EVERY), max_steps=steps, solver=COARSE).field


def by_parameters(field, data: hj.Trajectories, learned_from: hj.Trajectories, method: str) -> Adaptation:
    """Adapt by a method that does not train the network, or may."""
    settings, learned_from = hj.Settings(solver=COARSE), selected(learned_from)
    with warnings.catch_warnings(action="ignore"):  # the step is coarse for speed
        return hj.adapt(field, selected(data), method=method, settings=settings, learned_from=learned_from)


def selected(data: hj.Trajectories) -> hj.Trajectories:
    """Return equally many windows for each number of trajectories, as they are dear.

    Each trajectory's begin a window later than those of the one before it: of eight trajectories they would all be
    beginnings, which say little of what comes after.
    """
    every, each = WINDOW * len(data), range(len(data))
    return concatenate([pieces(data[i : i + 1], every, WINDOW, WINDOW * i) for i in each])


def study(config: Config, kept: Kept) -> list[Row]:
    """Return a row for each shift, model, method, number of trajectories and seed."""
    trained = sources(config, kept)
    rows = [row for shift in config.shifts for row in before(config, trained, shift)]
    of_source = {(row["shift"], row["model"], row["seed"]): row["mse"] for row in rows}
    jobs = {}
    for seed, shift, model, n in product(range(config.seeds), config.shifts, MODELS, config.sizes):
        source = trained[model, seed], of_source[shift, model, seed]
        jobs[f"{shift}, {model}, N = {n}, seed {seed}"] = partial(adapted, config, *source, shift, model, n, seed)
    return rows + rows_of(kept(PART, jobs))


def sources(config: Config, kept: Kept) -> dict[tuple[str, int], hj.AbstractVectorField]:
    def train(model: str, seed: int) -> Found:
        return [], {"weights": weights(learned(untrained(model, config, seed), known(config, seed), config.steps))}

    each = list(product(MODELS, range(config.seeds)))
    found = kept(f"{PART} source", {f"{model}, seed {seed}": partial(train, model, seed) for model, seed in each})
    return {
        (model, seed): with_weights(untrained(model, config, seed), found[f"{model}, seed {seed}"][1]["weights"])
        for model, seed in each
    }


def before(config: Config, trained, shift: str) -> list[Row]:
    test = tested(config, shift)
    return [
        _tags(shift, model, seed) | {"mode": SOURCE_ONLY, "n": 0, "mse": error(source, test, COARSE), "rho": 0.0}
        for (model, seed), source in trained.items()
    ]


@cache
def known(config: Config, seed: int) -> hj.Trajectories:
    """Return what a source learns from."""
    return reacting(fitzhugh_nagumo(plane(config.points)), SOURCES, (SOURCE, seed))


@cache
def tested(config: Config, shift: str) -> hj.Trajectories:
    return reacting(fitzhugh_nagumo(plane(config.points), *SHIFTS[shift]), -(-config.n_test // SHARE), (TEST, 0))


@cache
def targets(config: Config, shift: str, seed: int) -> hj.Trajectories:
    return reacting(fitzhugh_nagumo(plane(config.points), *SHIFTS[shift]), max(config.sizes), (TARGET, seed))


def adapted(config: Config, source, error_before: float, shift: str, model: str, n: int, seed: int) -> Found:
    """Return the rows of a source adapted to N trajectories by each method."""
    data, test, chosen = targets(config, shift, seed)[:n], tested(config, shift), dict[str, str | None]()
    fields = {
        FINE_TUNED: learned(source, data, min(TUNING, config.steps)),
        TARGET_ONLY: learned(untrained(model, config, seed), data, min(SCRATCH, config.steps)),
    }
    if model == HYBRID:
        adapt = partial(by_parameters, source, data, known(config, seed))
        fields[LEAST_SQUARES], found = adapt("theta_least_squares").field, adapt(AUTO)
        fields[AUTO], chosen[AUTO] = found.field, found.chosen
    errors = {mode: error(field, test, COARSE) for mode, field in fields.items()}
    return [
        _tags(shift, model, seed)
        | {"mode": mode, "n": n, "mse": mse, "rho": 1 - mse / error_before, "chosen": chosen.get(mode)}
        for mode, mse in errors.items()
    ], {}


def _tags(shift: str, model: str, seed: int) -> dict[str, Any]:
    return {"part": PART, "shift": shift, "model": model, "seed": seed, "draw": 0}
