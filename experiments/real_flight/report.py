"""What `python -m experiments.real_flight` leaves in its folder: report, rows, figures and models."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np
from rich.console import Console

import hybrid_jax
from experiments.paper.claims import Claim
from experiments.paper.figures import save_figure
from experiments.real_flight.claims import flight_claims
from experiments.real_flight.config import NANODRONE_STEPS, RealFlightConfig
from experiments.real_flight.figures import (
    Curve,
    Restarted,
    colour_of,
    errors_by_size,
    errors_by_step,
    predicted_flight,
    residual_by_speed,
)
from experiments.real_flight.logs import Flown, cut, stretch
from experiments.real_flight.models import Craft
from experiments.real_flight.recipes import RECIPES
from experiments.real_flight.rows import Cell, FlightRow, by_name, cell_name, cells, to_csv
from experiments.real_flight.study import Study
from experiments.real_flight.tables import choice_tables, fold_tables, log_tables, parameter_tables, score_tables
from experiments.real_flight.train import Taught
from experiments.reporting.environment import environment
from experiments.reporting.report import print_tables
from experiments.reporting.report_page import sections
from experiments.reporting.report_tables import Table, verdicts
from hybrid_jax.dynamics.base import AbstractVectorField
from hybrid_jax.dynamics.terms import nominal_values
from hybrid_jax.flights.splits import flight_of
from hybrid_jax.io.files import json_text, json_value, write_whole
from hybrid_jax.sweep.lanes import lane

PIECES = 6  # predictions in the figure of a flight
GIVEN = (
    "An interval of θ_p takes the network as given, and comes from windows of 10 steps that share no sample; it knows "
    "nothing of what the model lacks."
)
VALIDATION = "Validation flights stop every training and are not among the N windows."


@dataclass(frozen=True)
class Outcome:
    """All that the report is made from."""

    name: str
    config: RealFlightConfig
    before: Craft
    after: Craft
    flown: Mapping[str, Flown]
    dt: float
    found: Study

    @property
    def rows(self) -> list[FlightRow]:
        """One for each test."""
        return [scored.row for scored in self.found.scored]


def write_outcome(outcome: Outcome, console: Console) -> None:
    """Write models, figures and, last, the report; print its tables."""
    out = outcome.config.out / outcome.name
    save_models(out / "models", outcome)
    captions = draw(out, outcome)
    claims = flight_claims(outcome.rows)
    tables = outcome_tables(outcome, claims)
    record = to_record(outcome, claims, captions)
    shown = json.dumps(record["config"], indent=1, ensure_ascii=False)
    page = sections(head(outcome), tables, captions, record["notes"], record["environment"], shown)
    files = {"rows.csv": to_csv(outcome.rows), "report.md": page, "report.json": json_text(record)}
    for name, content in files.items():
        write_whole(out / name, content)
    print_tables(console, [*score_tables(outcome.rows, outcome.dt), *judged(claims)])
    console.print(
        f"Fold by fold, parameters, checks of every log: {out / 'report.md'}", highlight=False, soft_wrap=True
    )


def outcome_tables(outcome: Outcome, claims: Sequence[Claim]) -> list[Table]:
    """Scores first, the logs last."""
    rows = outcome.rows
    records = [record for flown in outcome.flown.values() for record in flown.records]
    return [
        *score_tables(rows, outcome.dt),
        *judged(claims),
        *fold_tables(rows),
        *choice_tables(outcome.found.choices),
        *parameter_tables(rows, nominal(outcome.before)),
        *log_tables(records),
    ]


def judged(claims: Sequence[Claim]) -> list[Table]:
    """The claims, if there are any."""
    return [verdicts(claims)._replace(title="What should come of it")] if claims else []


def to_record(outcome: Outcome, claims: Sequence[Claim], captions: Mapping[str, str]) -> dict[str, Any]:
    """report.json."""
    stages = outcome.found.stages
    record = {
        "experiment": outcome.name,
        "config": outcome.config.described(),
        "environment": environment(stages.seconds),
        "rows": [asdict(row) for row in outcome.rows],
        "claims": [asdict(claim) for claim in claims if claim.holds is not None],
        "not_judged": [{"id": c.id, "text": c.text, "why": c.measured} for c in claims if c.holds is None],
        "figures": dict(captions),
        "notes": [*stages.notes(), VALIDATION, GIVEN],
        "vehicle": {"before": asdict(outcome.before), "after": asdict(outcome.after)},
        "folds": [_fold_record(fold) for fold in outcome.found.folds],
        "choices": outcome.found.choices,
        "logs": {name: flown.records for name, flown in outcome.flown.items()},
    }
    return json_value(record)


def head(outcome: Outcome) -> str:
    """What was done, for a reader who has seen nothing else."""
    config, rows = outcome.config, outcome.rows
    flights = ", ".join(f"{len(flown.logs)} {name}" for name, flown in outcome.flown.items())
    seconds = {name: sum(record["seconds"] for record in flown.records) for name, flown in outcome.flown.items()}
    of = ", ".join(f"{name} {value:.0f} s" for name, value in seconds.items())
    recipes = "\n".join(f"- recipe **{name}**: {RECIPES[name].about}" for name in config.tried)
    adapted = (
        f"Models learn from the source's flights, then from N windows of the target's ({config.draw}), and predict "
        if "target" in outcome.flown
        else "Models learn from flights and predict "
    )
    learned = ", ".join(outcome.before.learn)
    return f"""# {outcome.name}

{adapted}flights that they have not seen, open loop from every sample with the recorded rotor speeds.
{flights} flights ({of}{"; simulated" if config.simulated else ""}), in {len(outcome.found.folds)} folds by \
{config.folds_by}; {len(rows)} tests, {config.seeds} seeds.

- **hybrid**: a multirotor that learns {learned} (or what its recipe says), plus a small network seen from the body
- **no-physics**: the same network with ṗ = v and the attitude's kinematics
- **physics-only**: the multirotor alone
- **rigid body + linear residual**: the nominal rigid body, and a linear map of state and input fitted to its defects
- **fine-tuned**: from the source's model; **scratch**: from nominal values; **zero-shot**: the source's model as it is
{recipes}

Errors are lengths of vectors, of rotation the angle. An RMSE is over all test windows."""


def curves(outcome: Outcome) -> dict[Cell, Curve]:
    """Errors at every step of the cells that a figure has room for, all folds' windows together."""
    power = 1 if outcome.config.protocol == "nanodrone" else 2
    most = max(row.n_train for row in outcome.rows)
    found: dict[Cell, Curve] = {}
    for cell in cells(outcome.rows):
        model, mode, n = cell
        if n not in (0, most) or (mode == "scratch" and model not in ("hybrid", "linear_residual")):
            continue
        own = [scored for scored in outcome.found.scored if scored.row.cell == cell]
        by_seed = []
        for seed in sorted({scored.row.seed for scored in own}):
            tests = [scored for scored in own if scored.row.seed == seed]
            weights = np.array([scored.row.windows for scored in tests], float)
            errors = np.array([scored.mean if power == 1 else scored.rms for scored in tests])
            by_seed.append((np.tensordot(weights, errors**power, 1) / weights.sum()) ** (1 / power))
        found[cell] = Curve(np.mean(by_seed, axis=0), np.std(by_seed, axis=0))
    return found


def draw(out: Path, outcome: Outcome) -> dict[str, str]:
    """All figures as PNG and SVG; file → caption."""
    nanodrone = outcome.config.protocol == "nanodrone"
    measure = f"mean error over {NANODRONE_STEPS} steps" if nanodrone else "RMSE"
    steps = errors_by_step(curves(outcome), outcome.dt, "Error against horizon", "mean error" if nanodrone else "RMSE")
    figures = {"errors_by_step": (steps, f"Error against horizon, {measure}, test flights of all folds")}
    if any(row.n_train for row in outcome.rows):
        by_size = errors_by_size(outcome.rows, outcome.dt, "Error against the amount of target flight")
        figures["errors_by_size"] = (by_size, "Error against N, the windows of the target learned from")
    hybrids = _hybrids(outcome.found)
    if hybrids:
        figures["predicted_flight"] = (_flight(outcome), "A stretch of a test flight and its predictions")
        figures["residual_by_speed"] = (
            _residual(outcome, hybrids),
            "What the network adds to the physics on test flights, against speed",
        )
    for name, (figure, _) in figures.items():
        save_figure(figure, out / name)
    return {f"{name}.png": caption for name, (_, caption) in figures.items()}


def save_models(folder: Path, outcome: Outcome) -> None:
    """Every trained model by name, with what is known about it."""
    scores = {(row.fold, *row.cell, row.seed): row.scores for row in outcome.rows}
    for (number, model, mode), taught in outcome.found.taught.items():
        fold = outcome.found.folds[number].name
        for index, each in enumerate(taught.lanes):
            n = len(each.subset) if mode in ("fine_tuned", "scratch") else 0
            about = {"tested_on": fold, "model": model, "mode": mode, "n_train": n, "seed": each.seed}
            about |= {"dt": outcome.dt, "scores": json_value(scores[fold, model, mode, n, each.seed])}
            name = f"fold{number}-{model}-{mode}-{n}-seed{each.seed}.npz"
            hybrid_jax.save(folder / name, lane(taught.trained.fields, index), about)


def nominal(craft: Craft) -> dict[str, float]:
    """Nominal values of what is learned, entry by entry, named as in the rows."""
    values = nominal_values(craft.vehicle, craft.terms)
    shapes = {name: np.shape(value) for name, value in craft.physics(RECIPES["staged"]).theta().items()}  # type: ignore
    return by_name({name: np.reshape(values[name], shape) for name, shape in shapes.items()}, float)


def _fold_record(fold) -> dict[str, Any]:
    parts = {part: [flight_of(log) for log in getattr(fold, part)] for part in ("train", "validation", "test")}
    return {"tested_on": fold.name} | parts


def _hybrids(found: Study) -> dict[str, Taught]:
    """The hybrids of the first fold, by mode."""
    modes = ("fine_tuned", "source_only", "zero_shot")
    return {mode: found.taught[0, "hybrid", mode] for mode in modes if (0, "hybrid", mode) in found.taught}


def _last(taught: Taught) -> tuple[Cell, AbstractVectorField]:
    """Seed 0 of the largest size: its number of windows, and the model."""
    most = max(len(each.subset) for each in taught.lanes)
    index = next(i for i, each in enumerate(taught.lanes) if len(each.subset) == most)
    return ("hybrid", "", most), lane(taught.trained.fields, index)


def _flight(outcome: Outcome):
    config, fold = outcome.config, outcome.found.folds[0]
    shown = stretch(fold.test, config.longest)
    windows = shown.windows[:PIECES]
    starts = shown.begin + outcome.dt * config.longest * np.arange(len(windows))
    inside = outcome.dt * np.arange(config.longest + 1)
    truth = np.concatenate([windows.x0[:1], *windows.x])
    mode = next(iter(_hybrids(outcome.found)))
    fields = {model: _last(outcome.found.taught[0, model, mode])[1] for model in config.models}
    fields["thrust"] = outcome.after.thrust()

    def restarted(model: str, field: AbstractVectorField) -> Restarted:
        states = np.asarray(hybrid_jax.rollout_batch(field, windows.x0, windows.u, windows.dt))
        pieces = [(at + inside, np.vstack([x0, x])) for at, x0, x in zip(starts, windows.x0, states, strict=True)]
        return Restarted(cell_name((model, mode if model != "thrust" else "nominal", 0)), colour_of(model), pieces)

    time = shown.begin + outcome.dt * np.arange(len(truth))
    title = f"Test flight {flight_of(shown.flight)}, predicted {outcome.dt * config.longest:.3g} s at a time"
    return predicted_flight(time, truth, [restarted(*each) for each in fields.items()], title)


def _residual(outcome: Outcome, hybrids: Mapping[str, Taught]):
    windows = cut(outcome.found.folds[0].test, 1).windows
    x, u = windows.x0, windows.u[:, 0]
    speed = np.linalg.norm(x[:, 7:10], axis=1)

    def added(taught: Taught) -> np.ndarray:
        field: Any = _last(taught)[1]
        return np.asarray(jax.jit(jax.vmap(field.residual))(x, u))

    named = {cell_name(("hybrid", mode, 0)): added(taught) for mode, taught in hybrids.items()}
    return residual_by_speed(speed, named, "What the network adds, against speed")
