"""The third study: Gray–Scott in the protocol of Neural Context Flows, four environments and then four new ones."""

from functools import partial
from typing import Any

import jax
import numpy as np

import hybrid_jax as hj
from experiments.reaction_diffusion.config import Config
from experiments.reaction_diffusion.models import error, pieces, weights, with_weights
from experiments.reaction_diffusion.systems import D_U, D_V, SCOTT_COARSE, Conversion, gray_scott, patterns
from experiments.reporting.results import Row
from experiments.runner.stages import Found, Kept, rows_of
from hybrid_jax.networks import GridNetwork, zero_output
from hybrid_jax.networks.normalisation import ChannelScaling
from hybrid_jax.trajectories import concatenate

PART = "gray_scott"
TRAINED_IN = tuple((f, k) for f in (0.030, 0.039) for k in (0.058, 0.062))
NEW = tuple((f, k) for f in (0.033, 0.036) for k in (0.059, 0.061))
GUESS = (0.0345, 0.060)  # F and k in all environments at the start
TRAIN, ADAPT, TEST = 30, 31, 32  # first numbers of the seeds of data
EVERY = 3  # intervals between the windows that are trained on
# Most Gauss–Newton steps with F and k held at the guess, of each start, and then with both free, of the best. Free at
# first, they would stand for the reaction that the network does not yet know, and come back slowly.
HELD, FREE = 20, 140
UNITS = 16  # of the network, at most --hidden
SHARE = 3  # test trajectories of an environment: --n-test over this
SCALING = ChannelScaling((0.6, 0.15), (0.3, 0.15), (0.02,))


def trained(start: Any, data: hj.Trajectories, steps: int, held: bool) -> Found:
    """Return the weights after Gauss–Newton, and the loss; `held`: for the network only."""
    field = hj.Hybrid(hj.Frozen(start.physics), start.residual) if held else start
    fit = hj.fit_gauss_newton(field, data, max_steps=steps, solver=SCOTT_COARSE)
    found: Any = fit.field
    loss = np.nan_to_num(fit.loss, nan=np.inf)
    return [], {"weights": weights(hj.Hybrid(start.physics, found.residual) if held else found), "loss": loss}


def source_model(config: Config, kept: Kept) -> Any:
    """Train a hybrid on one trajectory in each of the four environments, with F and k of each."""
    parts = [patterns(gray_scott(TRAINED_IN, True, config.points), e, 1, (TRAIN, e)) for e in range(len(TRAINED_IN))]
    physics = gray_scott([GUESS] * len(TRAINED_IN), False, config.points)
    data = concatenate([pieces(part, EVERY) for part in parts])
    hj.check_grid(physics.grid, data, diffusivity=(D_U, D_V), substeps=SCOTT_COARSE.substeps)
    starts = [untrained(physics, min(UNITS, config.hidden), seed) for seed in range(config.starts)]
    name, most = f"{PART} source in {len(data)} windows", min(HELD, config.steps)
    jobs = {f"start {seed}": partial(trained, start, data, most, True) for seed, start in enumerate(starts)}
    found = [arrays for _, arrays in kept(f"{name}, F and k held", jobs).values()]
    best = with_weights(starts[0], min(found, key=lambda arrays: arrays["loss"])["weights"])
    job = {name: partial(trained, best, data, min(FREE, 4 * config.steps), False)}
    return with_weights(best, kept(f"{name}, F and k free", job)[name][1]["weights"])


def untrained(physics: Any, hidden: int, seed: int) -> Any:
    size = {"outputs": 1, "hidden": hidden}
    network = hj.residual_network(2, 0, jax.random.key(seed), **size, activation="tanh", norm="none", scaling=SCALING)
    # Zero at first, or 40 s of a wrong reaction hide the right one.
    rate: Any = zero_output(network)
    return hj.Hybrid(physics, Conversion(GridNetwork(rate, physics.grid)))


def study(config: Config, kept: Kept) -> list[Row]:
    """Adapt only F and k to one trajectory of each new environment: a row each."""
    source = source_model(config, kept)

    def adapt(index: int, environment: tuple[float, float]) -> Found:
        truth = gray_scott([environment], True, config.points)
        seen = patterns(truth, 0, 1, (ADAPT, index))
        test = patterns(truth, 0, -(-config.n_test // SHARE), (TEST, index))
        middle = hj.Hybrid(gray_scott([GUESS], False, config.points), source.residual)
        fitted: Any = hj.fit_least_squares(middle, pieces(seen, 3, 3), solver=SCOTT_COARSE).field
        feed, kill = (float(value[0]) for value in fitted.physics.theta().values())
        row = {"part": PART, "environment": index, "seed": 0, "draw": 0, "F": environment[0], "k": environment[1]}
        row |= {"found_F": feed, "found_k": kill, "mse": error(fitted, test, SCOTT_COARSE)}
        row |= {"mse_before": error(middle, test, SCOTT_COARSE)}
        return [row], {}

    jobs = {f"environment {index}": partial(adapt, index, environment) for index, environment in enumerate(NEW)}
    return rows_of(kept(f"{PART} F and k", jobs))
