"""The first study: learn FitzHugh–Nagumo when physics contains only diffusion, as APHYNITY does."""

from functools import partial
from typing import Any

import jax
import numpy as np

import hybrid_jax as hj
from experiments.reaction_diffusion.config import CASES, Case, Config
from experiments.reaction_diffusion.models import error, pieces, weights
from experiments.reaction_diffusion.systems import COARSE, STEPS, A, B, fitzhugh_nagumo, plane, reacting
from experiments.reporting.results import Row
from experiments.runner.stages import Found, Kept, rows_of
from hybrid_jax.networks.normalisation import ChannelScaling

PART = "forecast"
TRAIN, TEST = 10, 11  # first numbers of the seeds of data: no trajectory is in both
GUESS = (2 * A, B / 2)  # where a and b start
EVERY = 4  # intervals between the windows of the first stage
ANOTHER = 1000  # between the seeds of two networks of one trial
TRIED = 10  # steps of every start; the best after them was the best at the end in 6 of 8 trials with seeds from 100


def scaling(kernel: int) -> ChannelScaling:
    """Return the network's input scaling, equal for all seeds so that one program serves; states are in −0.7 … 1."""
    read = 2 * kernel**2
    return ChannelScaling((0.25,) * read, (0.35,) * read)


def untrained(case: Case, config: Config, seed: int) -> hj.AbstractVectorField:
    grid, key = plane(config.points), jax.random.key(seed)
    if case.physics == "complete":
        return fitzhugh_nagumo(grid, *GUESS, k=0.0)
    physics = hj.diffusion(grid, GUESS)
    if not case.kernel:
        return physics
    hidden = config.hidden if case.kernel == 1 else config.channels
    network = hj.grid_network(grid, 0, key, kernel=case.kernel, hidden=hidden, scaling=scaling(case.kernel))
    return network if case.physics == "none" else hj.Hybrid(physics, network)


def trained(case: Case, config: Config, seed: int) -> hj.AbstractVectorField:
    """Train several models on single intervals of a few places, then the best on whole trajectories.

    Several begin because some networks end in a poor local minimum, which their training loss soon shows.
    """
    truth = fitzhugh_nagumo(plane(config.points))
    data = reacting(truth, 1, (TRAIN, seed), case.noise)
    starts = [untrained(case, config, seed + ANOTHER * i) for i in range(config.starts)]
    hj.check_grid(plane(config.points), data, diffusivity=GUESS, substeps=COARSE.substeps, name="training data")
    if not case.kernel:
        return hj.fit_least_squares(starts[0], data, solver=COARSE).field
    fit = partial(hj.fit_gauss_newton, penalty=case.penalty, weight=case.weight, solver=COARSE)
    first = [fit(start, pieces(data, EVERY), max_steps=min(TRIED, config.steps)) for start in starts]
    best = min(first, key=lambda found: found.loss if np.isfinite(found.loss) else np.inf).field
    if config.steps > TRIED:
        best = fit(best, pieces(data, EVERY), max_steps=config.steps - TRIED).field
    whole = pieces(data, STEPS // 5, STEPS // 5) if case.kernel > 1 else data
    return fit(best, whole, max_steps=config.polish).field


def study(config: Config, kept: Kept) -> list[Row]:
    """Return a row for each case and seed."""
    truth = fitzhugh_nagumo(plane(config.points))
    test = reacting(truth, config.n_test, (TEST, 0))
    cases = [case for case in CASES if case.name in config.cases]
    runs = [(case, seed) for case in cases for seed in range(min(config.seeds, case.seeds))]

    def work(case: Case, seed: int) -> Found:
        model = trained(case, config, seed)
        row = {"part": PART, "case": case.name, "seed": seed, "draw": 0, "mse": error(model, test, COARSE)}
        row |= _found(model) | {"trajectories": 1, "noise": case.noise}
        return [row], {"weights": weights(model)}

    return rows_of(kept(PART, {f"{case.name}, seed {seed}": partial(work, case, seed) for case, seed in runs}))


def _found(model: Any) -> dict[str, float | None]:
    """Return a and b, and the mean of their relative errors [%]; None without physics."""
    physics = model.physics if isinstance(model, hj.Hybrid) else model
    if (theta := getattr(physics, "theta", None)) is None:
        return {"a": None, "b": None, "parameter_error": None}
    a, b = (float(value) for value in theta()["diffusivity"])
    return {"a": a, "b": b, "parameter_error": 50 * (abs(a / A - 1) + abs(b / B - 1))}
