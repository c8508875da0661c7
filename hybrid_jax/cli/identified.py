"""`hybrid-jax adapt` and `check` for identified models, which have no states."""

from pathlib import Path
from typing import Any, cast

import jax
import numpy as np

from hybrid_jax.cli import page
from hybrid_jax.cli.command import NOTHING_CHANGED
from hybrid_jax.cli.identify import (
    ANYWAY,
    ENDS,
    LINES,
    Read,
    figure,
    identified,
    layout_of,
    predicted,
    read_checked,
    values_of,
    warned,
)
from hybrid_jax.cli.logs import require_unseen
from hybrid_jax.dynamics.actuators import Actuated
from hybrid_jax.estimation.least_squares import ravel_parameters
from hybrid_jax.estimation.uncertainty import named_parameters
from hybrid_jax.identification.fitting import Identified
from hybrid_jax.io.files import json_value
from hybrid_jax.io.models import Model, save

# Share of a value by which flights of one vehicle differ, and share that a parameter explains at least.
ALIKE, LEAST = 0.03, 0.2
REACH, SURE = 1.96, 1.5  # standard errors of an interval; half-widths that a change is at least
KEEP = "Keep the model. If something did change, you should fly manoeuvres that excite it more."
HEADER = ("parameter", "before", "after", "from", "to", "unit")


def adapt(options: Any, model: Model) -> int:
    """Identify the model again from logs after a change, beginning with its present parameters."""
    read, layout = _like(options, options.after, model), layout_of(model.about["identified"])
    found, logs = identified(read, layout), read.logs
    before, after = model.about["parameters"], values_of(found)
    with jax.enable_x64(True):  # in which it was identified
        changed = _changed(model, found)
    if changed:
        learned_from = {**model.about["learned_from"], **read.contents}
        about = {**model.about, "parameters": after, "learned_from": learned_from, "covariance": found.covariance}
        save(options.output, found.field, json_value(about))
    lines = [
        (name, f"{before[name]['value']:.4g}", *(f"{after[name][end]:.4g}" for end in ENDS), after[name]["unit"])
        for name in dict.fromkeys([*changed, *after])
    ]
    alone = [
        f"{name} from {before[name]['value']:.4g} to {value:.4g} ({low:.4g} to {high:.4g}) would by itself explain "
        f"{share:.0%} of how these logs differ."
        for name, (share, value, low, high) in changed.items()
    ]
    kept = found.field if changed else model.field
    shown = page.Page(
        f"What changed in {page.counted(logs, 'log')} of {options.after} ({found.seconds:.0f} s)?",
        f"Changed: {alone[0]}" if changed else "These logs show no change.",
        page.Table("Before, and after with 95 % intervals", HEADER, lines[:LINES]),
        [(f"Errors of predictions{' of the adapted model' * bool(changed)}", figure(kept, logs, layout))],
        [*warned(read, found), *alone[1:]],
        [f"On logs that were not used here: hybrid-jax check {options.output} LOGS." if changed else KEEP],
        [
            page.Table("All parameters", HEADER, lines),
            predicted(model.field, logs, layout, "before"),
            predicted(found.field, logs, layout, "adapted"),
        ],
        [*read.said, *read.failed],
    )
    told = {"parameters": after, "changed": changed, "model": options.output if changed else None}
    page.write(options.out, "adapt", shown, told)
    return 0 if changed else NOTHING_CHANGED


def check(options: Any, model: Model) -> int:
    """Compare predictions with each measured quantity, over all logs and in each."""
    read, layout = _like(options, options.flights, model), layout_of(model.about["identified"])
    logs = read.logs
    whole = predicted(model.field, logs, layout, "all logs")
    ends = "; ".join(f"{name} {error} {unit}" for name, unit, _, error in whole.lines)
    shown = page.Page(
        f"How well does {options.model.name} predict {page.counted(logs, 'log')} of {options.flights}?",
        f"After {layout.dt * layout.steps:.3g} s its RMS errors are: {ends}.",
        whole,
        [("Errors of predictions, all logs", figure(model.field, logs, layout))],
        [ANYWAY.format(len(read.failed))] * bool(read.failed),
        [f"If it is wrong: hybrid-jax adapt {options.model} {options.flights} -o adapted.npz."],
        [predicted(model.field, [log], layout, name) for name, log in zip(read.contents, logs, strict=True)],
        [*read.said, *read.failed],
    )
    rmse = {name: error for name, _, _, error in whole.lines}
    page.write(options.out, "check", shown, {"flights": list(read.contents), "rmse": rmse})
    return 0


def _like(options: Any, folder: Path, model: Model) -> Read:
    """Read logs for an identified model; none of them may be one of its training logs."""
    field = cast(Any, model.field)
    body = field.body if isinstance(field, Actuated) else field
    learned = tuple(name.partition("[")[0] for name in model.about["parameters"])
    read = read_checked(folder, options, body.vehicle, learned, lambda _: field)
    told = "command" if isinstance(field, Actuated) else "rotor_speed"
    for log in read.logs:
        if told not in log.signals:
            raise ValueError(f"{log.name}: has no {told}, which the model needs; leave it out")
    require_unseen(model.about["learned_from"], read.contents)
    return read


def _changed(model: Model, found: Identified) -> dict[str, tuple[float, float, float, float]]:
    """Return, for each parameter, the share of the change it explains by itself, its value and its interval.

    Often only combinations of parameters are identifiable. The change of one is fitted to the differences of all
    estimates by generalised least squares with their covariances; the best explanation is first.
    """
    before, restored = ravel_parameters(model.field)
    difference = np.asarray(ravel_parameters(found.field)[0]) - np.asarray(before)
    covariance = np.array(model.about["covariance"], float) + np.asarray(found.covariance)
    told = np.flatnonzero(np.isfinite(np.diagonal(covariance)))
    weight = np.linalg.pinv(covariance[np.ix_(told, told)])
    pulls, names = weight @ difference[told], [*named_parameters(model.field)]
    shares = pulls**2 / np.diagonal(weight) / max(pulls @ difference[told], 1e-30)
    changed = {}
    for place in np.argsort(-shares):
        shift, half = pulls[place] / weight[place, place], REACH / weight[place, place] ** 0.5
        shifts = (0.0, shift, shift - half, shift + half)
        moves = [np.eye(len(before))[told[place]] * each for each in shifts]
        old, *new = (float(named_parameters(restored(before + move))[names[told[place]]]) for move in moves)
        if shares[place] > LEAST and abs(shift) > SURE * half and abs(new[0] - old) > ALIKE * abs(old):
            changed[names[told[place]]] = (float(shares[place]), *new)
    return changed
