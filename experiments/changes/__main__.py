"""Which method adapts to one flight of ten seconds, after seven changes: python -m experiments.changes"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Annotated, Any, Literal, NamedTuple, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from matplotlib.figure import Figure

from experiments.paper import study
from experiments.paper.conditions import settings
from experiments.paper.config import CHANGED, ONE_FLIGHT, QUICK, SMOKE, OneFlight, preset_like
from experiments.paper.rates import Rates
from experiments.paper.regret import CLAIMS, ERRORS, TAGS, conclusion, error_figure, error_tables, regret_table
from experiments.paper.study import EVERY, target_splits, windows_of
from experiments.reporting.claims import evaluate, verdict_table
from experiments.reporting.names import FINE_TUNED, HYBRID
from experiments.reporting.report import Report, rows_in
from experiments.reporting.results import Results, Row
from experiments.runner import command
from experiments.runner.cache import identity_of
from experiments.runner.options import Named, distinct
from experiments.runner.stages import Found, Stages, rows_of
from experiments.worlds.flights import Sources, dataset, in_each_world, sources
from experiments.worlds.world import World
from hybrid_jax.adaptation import FineTune
from hybrid_jax.adaptation.auto import Auto, candidate
from hybrid_jax.adaptation.expectation import errors_at_ends, expected_errors
from hybrid_jax.adaptation.methods import scale_of
from hybrid_jax.adaptation.plausible import extended
from hybrid_jax.adaptation.results import Choice
from hybrid_jax.adaptation.selection import BLOCKS, blocks_of, fit_each
from hybrid_jax.dynamics.base import AbstractVectorField
from hybrid_jax.dynamics.rigid_body import RIGID_BODY_SPACE
from hybrid_jax.io.datasets import Dataset
from hybrid_jax.metrics import window_mse
from hybrid_jax.runtime import FAST_COMPILE, jit_with
from hybrid_jax.sweep.lanes import lane
from hybrid_jax.training.objective import Settings
from hybrid_jax.trajectories import Trajectories
from hybrid_jax.vehicle import STATE_SIZE

NAME = "changes"
INSIDE = "expected_inside"  # column: see `_share_inside`
SCALES = np.where(np.arange(STATE_SIZE) < [[STATE_SIZE], [3]], 1.0, np.inf)  # of all states, and of the position alone
Compared = Literal["fine_tune", "fine_tune_offset", "l2_sp"]
METHOD, OFFSET = Auto(), 0.3
L2_SP = FineTune(l2_sp=1e-2)


@dataclass(frozen=True)
class ChangesConfig(OneFlight):
    """Adapt to one flight after each change of the vehicle, and test every candidate to see what the choice missed."""

    compared: Annotated[tuple[Compared, ...], Named(name="methods"), partial(distinct, least=0)] = get_args(Compared)
    """Methods to compare with. fine_tune: Adam, as in the paper. fine_tune_offset: with --rates.offset 0.3. l2_sp: with
    a penalty on the distance from the source's parameters."""


PRESETS = {
    # With noise before the change, sources that learn at the paper's constant rate have larger errors.
    "paper": ChangesConfig(rates=Rates(pretraining=1e-3, decay=(0.3, 0.1))),
    "quick": preset_like(ChangesConfig, replace(QUICK, **ONE_FLIGHT, draws=4)),
    "smoke": preset_like(
        ChangesConfig,
        replace(SMOKE, **ONE_FLIGHT),
        sizes=(20,),
        worlds=("hummingbird",),
        changes=("external_force",),
        compared=("fine_tune",),
    ),
}


def of_world(world: World, config: ChangesConfig, stages: Stages) -> list[Row]:
    known = sources(world, config, stages)
    chosen = [change for change in CHANGED if change in config.changes]
    rows = [row for change in chosen for row in adapted(world, change, known, config, stages)]
    return [{"world": world.name, **row} for row in rows]


def report(record: Mapping[str, Any]) -> Report:
    rows = rows_in(record)
    verdicts = evaluate(CLAIMS, rows)
    tables = [verdict_table(verdicts, "Hypotheses"), regret_table(rows), *error_tables(rows)]
    return Report(record, draw(rows), tables, conclusion(rows), verdicts)


def draw(rows: Results) -> dict[str, tuple[Figure, str]]:
    about = "RMSE of the position predicted over 1 s; lower is better; bands reach from the least to the most"
    return {"errors": (error_figure(rows), about)}


def adapted(world: World, change: str, known: Sources, config: ChangesConfig, stages: Stages) -> list[Row]:
    """Return the rows of a change: every candidate, and the methods to compare with, for every draw and seed."""
    target = dataset(world, change, target_splits(config), config, stages)
    pool, test, drawn = target.splits["train"], target.splits["test"], windows_of(METHOD, config.sizes[0], config)[0]
    flights, shared = pool[drawn[:: config.seeds]], settings(config)

    def of_seed(draw: int, seed: int) -> list[Row]:
        field, windows = lane(known.fields, seed), pool[drawn[draw * config.seeds + seed]]
        choice = METHOD.solve(field, windows, windows, shared, known.windows).choice
        tested = jax.device_get(_candidates(field, choice, windows, flights, test, shared))
        inside = _share_inside(choice, windows, np.delete(tested.flown, draw, 0))
        rows = []
        for i, name in enumerate(choice.names):
            taken = i == int(choice.taken)
            tags = {"domain": change, "candidate": name, "draw": draw, "seed": seed, "taken": taken}
            numbers = dict(zip(ERRORS, tested.errors[i], strict=True))
            numbers |= {"probability": tested.probability[i], INSIDE: inside if taken else None}
            rows.append(tags | numbers)
        return rows

    def of_draw(draw: int) -> Found:
        return [row for seed in range(config.seeds) for row in of_seed(draw, seed)], {}

    jobs = {f"flight {draw}": partial(of_draw, draw) for draw in range(config.draws)}
    found = stages.kept(f"adapt {target.config['domain']}", jobs, identity_of(config.described(), known.fields, target))
    return rows_of(found) + [{"domain": change, **row} for row in compared(known.fields, config, stages, target)]


def compared(fields: AbstractVectorField, config: ChangesConfig, stages: Stages, target: Dataset) -> list[Row]:
    tuned = partial(study.adapted, HYBRID, FINE_TUNED, fields)
    offset = replace(config, rates=replace(config.rates, offset=OFFSET))
    fits = {
        "fine_tune": lambda: tuned(config, stages, target),
        "fine_tune_offset": lambda: tuned(offset, stages, target, "hybrid, offset"),
        "l2_sp": lambda: study.solved(f"l2_sp {target.config['domain']}", L2_SP, fields, config, stages, target),
    }
    rows = []
    for name in config.compared:
        errors = np.asarray(_errors(fits[name]().fields, target.splits["test"], settings(config)))
        tags = {"candidate": name, "probability": None, "taken": False}
        for i, own in enumerate(errors):
            case = {"draw": i // config.seeds, "seed": i % config.seeds}
            rows.append(tags | {INSIDE: None} | case | dict(zip(ERRORS, own, strict=True)))
    return rows


class Tested(NamedTuple):
    """The `ERRORS` of c candidates, and the `errors_at_ends` of the adapted model on each of f flights."""

    probability: Float[Array, " c"]
    errors: Float[Array, "c 2"]
    flown: Float[Array, "f 2 d"]


@jit_with(FAST_COMPILE)
def _candidates(
    field: AbstractVectorField,
    choice: Choice,
    windows: Trajectories,
    flights: Trajectories,
    test: Trajectories,
    shared: Settings,
) -> Tested:
    larger, places = extended(field, STATE_SIZE), blocks_of(len(windows), BLOCKS)
    # Of candidates that were not taken `choice` knows the parameters to first order alone.
    options = METHOD.plausible.sizes(larger, windows), shared.solver, scale_of(shared.objective)
    fits, _ = fit_each(candidate(larger, choice, 0), windows, choice.free, *options, METHOD.max_steps)
    choice = choice._replace(theta=fits.theta)
    adapted = candidate(larger, choice, choice.taken)

    def error(index):
        return _both_errors(candidate(larger, choice, index), test, shared)

    def of_flight(flight):
        blocks = jax.tree.map(lambda leaf: leaf[places[0]], flight), jnp.asarray(places[1])
        return jnp.mean(jax.lax.map(lambda b: errors_at_ends(adapted, b[0], b[1], shared.solver), blocks), axis=0)

    errors = jax.lax.map(error, jnp.arange(len(choice.names)))
    return Tested(choice.probability, errors, jax.lax.map(of_flight, flights))


@jit_with(FAST_COMPILE)
def _errors(fields: Any, test: Trajectories, shared: Settings):
    return jax.lax.map(lambda field: _both_errors(field, test, shared), fields)


def _both_errors(field: AbstractVectorField, test: Trajectories, shared: Settings) -> Array:
    return jnp.stack([jnp.mean(window_mse(field, test, EVERY, shared.solver, scale)) for scale in SCALES])


def _share_inside(choice: Choice, windows: Trajectories, flown: np.ndarray) -> float | None:
    """Return the share of other flights' errors inside the 80 % interval; None without flights."""
    expected, inside = choice.expected(windows, RIGID_BODY_SPACE), []
    for of_flight in flown:
        truth = expected_errors(of_flight[None], (1.0, 2.0), RIGID_BODY_SPACE)  # names of horizons do not matter
        for known, own in zip(expected.values(), truth.values(), strict=True):
            inside += [low <= own[name][0] <= high for name, (_, low, high) in known.items()]
    return float(np.mean(inside)) if inside else None


ABOUT = "One flight of ten seconds after a change of the vehicle: which method is chosen, and is it the right one?"
ABOUT += " After no change, from a hover, and after changes that no candidate expresses: experiments.changes.harm."
main = partial(command.run, NAME, ABOUT, partial(in_each_world, NAME, TAGS, of_world, report), presets=PRESETS)

if __name__ == "__main__":
    main()
