"""The second study: the equations change, and a few trajectories show how: the paper's Figs. 3 and 5 for a PDE."""

import jax
import numpy as np

import hybrid_jax as hj
from experiments.reaction_diffusion.config import Config
from experiments.reaction_diffusion.forecast import GUESS, scaling
from experiments.reaction_diffusion.models import error, pieces, weights, with_weights
from experiments.reaction_diffusion.systems import COARSE, A, B, K, fitzhugh_nagumo, plane, reacting
from experiments.reporting.names import FINE_TUNED, HYBRID, LEAST_SQUARES, NO_PHYSICS, SOURCE_ONLY, TARGET_ONLY
from experiments.reporting.results import Row
from experiments.runner.stages import Found, Kept
from hybrid_jax.dynamics.disturbance import physics_of, without_disturbance

PART, AUTO = "shifted", "auto"
SOURCE, TARGET, TEST = 20, 21, 22  # first numbers of the seeds of data
SHIFTS = {"parameter_shift": (2 * A, B / 2, 2 * K, 0.0), "new_term": (A, B, K, -0.5)}
SOURCES = 2  # trajectories that a source learns from
EVERY = 12  # intervals between the windows to learn from
TUNING, SCRATCH = 6, 14  # most Gauss–Newton steps from the source, and from random weights
WINDOW = 3  # intervals of a window to adapt parameters to
MODELS = {HYBRID: 1, NO_PHYSICS: 3}  # kernel of the network


def untrained(model: str, config: Config, seed: int) -> hj.AbstractVectorField:
    grid, kernel = plane(config.points), MODELS[model]
    key = jax.random.key(100 + seed)
    hidden = config.units if kernel == 1 else config.channels
    network = hj.grid_network(grid, 0, key, kernel=kernel, hidden=hidden, scaling=scaling(kernel))
    return network if model == NO_PHYSICS else hj.Hybrid(hj.diffusion(grid, GUESS), network)


def learned(field, data: hj.Trajectories, steps: int) -> hj.AbstractVectorField:
    return hj.fit_gauss_newton(field, pieces(data, EVERY), max_steps=steps, solver=COARSE).field


def by_parameters(field, data: hj.Trajectories, method: str) -> tuple[hj.AbstractVectorField, str | None]:
    """Adapted by a method that leaves the network alone, or may; and what `auto` chose."""
    settings = hj.Settings(solver=COARSE)
    result = hj.adapt(field, pieces(data, WINDOW, WINDOW), method=method, settings=settings)
    return result.field, result.chosen


def study(config: Config, kept: Kept) -> list[Row]:
    """A row for each shift, model, way of learning, number of trajectories and seed."""
    grid, rows = plane(config.points), []
    for seed in range(config.seeds):
        source_data = reacting(fitzhugh_nagumo(grid), SOURCES, (SOURCE, seed))
        sources = {}
        for model in MODELS:
            start = untrained(model, config, seed)

            def train(start=start, data=source_data) -> Found:
                return [], {"weights": weights(learned(start, data, config.steps))}

            found = kept(f"{PART}: source, {model}, seed {seed}", train)[1]["weights"]
            sources[model] = with_weights(start, found)
        for shift in config.shifts:
            truth = fitzhugh_nagumo(grid, *SHIFTS[shift])
            pool = reacting(truth, max(config.sizes), (TARGET, seed))
            test = reacting(truth, config.test, (TEST, 0))
            for model, source in sources.items():
                before = error(source, test, COARSE)
                tags = {"part": PART, "shift": shift, "model": model, "seed": seed, "draw": 0}
                rows.append(tags | {"mode": SOURCE_ONLY, "n": 0, "mse": before, "rho": 0.0})
                for n in config.sizes:
                    name = f"{PART}: {shift}, {model}, {n}, seed {seed}"

                    def adapt(model=model, source=source, data=pool[:n], before=before, tags=tags, test=test) -> Found:
                        fresh = untrained(model, config, tags["seed"])
                        fields = {
                            FINE_TUNED: learned(source, data, min(TUNING, config.steps)),
                            TARGET_ONLY: learned(fresh, data, min(SCRATCH, config.steps)),
                        }
                        chosen = {}
                        if model == HYBRID:
                            fields[LEAST_SQUARES], _ = by_parameters(source, data, "theta_least_squares")
                            fields[AUTO], chosen[AUTO] = by_parameters(source, data, "auto")
                        errors = {mode: error(field, test, COARSE) for mode, field in fields.items()}
                        return [
                            tags
                            | {"mode": mode, "n": len(data), "mse": mse, "rho": 1 - mse / before}
                            | {"chosen": chosen.get(mode), "diffusivity": _diffusivity(fields[mode])}
                            for mode, mse in errors.items()
                        ], {}

                    rows += kept(name, adapt)[0]
    return rows


def _diffusivity(field) -> list[float] | None:
    theta = getattr(physics_of(without_disturbance(field)), "theta", None)
    return None if theta is None else np.asarray(theta()["diffusivity"]).tolist()
