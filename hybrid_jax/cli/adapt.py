"""The verb `hybrid-jax adapt`: find what changed, and adapt a model."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro

from hybrid_jax.adaptation import Adaptation
from hybrid_jax.cli import errors, identify, page
from hybrid_jax.cli.command import NOTHING_CHANGED, step
from hybrid_jax.cli.identify import KEEP
from hybrid_jax.cli.logs import FlightOptions, Flights, Known, flights_for, known_of, unlike
from hybrid_jax.dynamics.base import AbstractVectorField
from hybrid_jax.estimation.uncertainty import named_parameters
from hybrid_jax.identification.adaptation import adapted
from hybrid_jax.identification.learning import rmse_by_flight, without_past
from hybrid_jax.io.files import json_value
from hybrid_jax.io.models import load, save
from hybrid_jax.trajectories import Trajectories

__all__ = ["Options", "run"]
UNLIKELY = 0.05  # probability that nothing changed below which the vehicle has changed
SHOWN = 5  # parameters beside the answer
DIFFER = "These flights differ from the model, but do not determine which of its parameters changed."
ALONE = "only its physics is kept, because it predicts the flights before better without the network."
STILL = "These flights hardly move, so they determine hardly anything."
TAUGHT = ", to which the model was adapted"
LACKED = (
    "Effects that the model lacked explain these flights as well: {}. Flights before may have had them: name those "
    "that the vehicle always has, such as drag, in `learn` of the vehicle file, and fit again."
)


@dataclass(frozen=True)
class Options(FlightOptions):
    """Adapt a model to logs from after a change. You should have at least ten seconds of flight.

    Exits with code 4, without writing a model, if these flights show no change.
    """

    source: Annotated[Path, tyro.conf.Positional]
    """Model that `hybrid-jax fit` wrote."""
    after: Annotated[Path, tyro.conf.Positional]
    """Folder of logs after the change."""
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """File for the adapted model."""
    out: Path = Path("runs/adapt")
    """Folder for report.html and report.json."""


def run(options: Options) -> int:
    model = load(options.source)
    if "identified" in model.about:
        return identify.adapt(options, model)
    known = known_of(options.source, model)
    flights = flights_for(known, options.after, options, changed=True)
    x0, u, x = (np.asarray(known.about["windows"][part], "f4") for part in ("x0", "u", "x"))
    with step("adapting") as done:
        field, found = adapted(known.field, flights.logs, Trajectories(x0, u, x, known.dt))
        done(f"{found.windows} windows, chose {found.chosen}")
    different = bool(found.changed) or found.physics_only or found.candidates["source"] < UNLIKELY
    if different:
        about = {**known.about} | {"adapted_from": str(options.source), "expected": found.expected}
        about |= {"learned_from": known.about["learned_from"] | flights.contents}
        save(options.output, field, json_value(about))
    record = found.to_dict() | {"model": options.output if different else None}
    page.write(options.out, "adapt", _page(options, known, flights, field, found, different), record)
    return 0 if different else NOTHING_CHANGED


def _range(low: float, high: float) -> str:
    return f"{low:.3g} to {high:.3g}" if np.isfinite([low, high]).all() else ""


def _page(
    options: Options, known: Known, flights: Flights, field: AbstractVectorField, found: Adaptation, different: bool
) -> page.Page:
    learned = named_parameters(without_past(known.field))
    names = [*found.changed, *(name for name in found.parameters if name not in found.changed)]
    changes = [(name, found.parameters[name].before, found.parameters[name]) for name in names]
    changed = changes[: len(found.changed)]
    effective: dict[Any, dict[str, None]] = {}  # why → names without their indices
    for name, _, one in changes:
        effective.setdefault(one.effective, {})[name.partition("[")[0]] = None
    # What was zero, such as an added drag, is new to the model; a rotor's efficiency was one.
    own, lacked = ([each for each in changed if (each[0] in learned or each[1] != 0) == of] for of in (True, False))
    fields = {"before": known.field} | ({"adapted": field} if different else {})
    curves = {name: rmse_by_flight(each, flights.logs, known.steps) for name, each in fields.items()}
    old, *new = (errors.texts(each.mean(axis=0)[-1])[1] for each in curves.values())
    error = f"On these flights the error of velocity after {known.steps * known.dt:g} s"
    what = "; ".join(f"{name} from {value:.3g} to {one}" for name, value, one in own[:2])
    answer = f"Changed: {what}." if own else DIFFER
    if not changed and found.candidates["source"] >= UNLIKELY:
        answer = f"These flights show no change; of the model {ALONE}" if different else "These flights show no change."
    todo = f"On flights that were not used here: hybrid-jax check {options.output} FLIGHTS." if different else KEEP
    title = "What changed" if changed else "Parameters, none of which clearly changed"
    moved = [each for each in changes if each[1] != each[2].value] or changes
    main = ([*own, *lacked] or moved)[:SHOWN]
    rows = [(name, str(one), f"{value:.4g}", _range(*one.change)) for name, value, one in main]
    was = known.about.get("expected", {}).get("velocity")  # of a model that `fit` wrote
    expected = f", where {was[0]:.3g} m/s was expected on a new flight" if was else ""
    unseen = [each["velocity"] for each in [*found.expected.values()][:1] if different]
    return page.Page(
        f"What changed in {page.counted(flights.logs, 'flight')} of {options.after} ({flights.seconds:.0f} s)?",
        answer,
        page.Table(f"{title} (95 % intervals)", ("parameter", "after", "before", "change"), rows) if rows else None,
        [(f"RMSE on these flights{TAUGHT * different}", errors.figure(curves, known.dt))],
        [
            f"{error} was {old}; it is now {new[0]}." if new else f"{error} is {old}{expected}.",
            *[f"On new flights you should expect {v:.3g} m/s ({low:.3g} to {high:.3g})." for v, low, high in unseen],
            *([f"Of the model before {ALONE}"] if found.physics_only else []),
            *([LACKED.format(", ".join(name for name, *_ in lacked))] if lacked else []),
            *errors.unknown(found),
            *(f"The values of {', '.join(names)} are effective: {why}." for why, names in effective.items() if why),
            *[STILL] * flights.still,
            *unlike(known, flights),
            *flights.warnings,
        ],
        [todo],
        [errors.parameter_table(found)],
        [*flights.notes, *found.report().splitlines()],
    )
