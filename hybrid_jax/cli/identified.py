"""What `hybrid-jax adapt` and `check` do with a model that was identified, which knows no states."""

from pathlib import Path
from typing import Any, cast

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
from hybrid_jax.io.files import json_value
from hybrid_jax.io.models import Model, save

ALIKE = 0.02  # by which flights of one vehicle differ, of which an interval of one flight knows nothing
HEADER = ("parameter", "before", "after", "from", "to", "unit")


def adapt(options: Any, model: Model) -> int:
    """Identify it again, from where it is, by logs after a change."""
    read, layout = _like(options, options.after, model), layout_of(model.about["identified"])
    found, logs = identified(read, layout), [*read.logs.values()]
    before, after = model.about["parameters"], values_of(found)
    changed = [name for name, one in after.items() if _apart(one, before[name])]
    if changed:
        learned_from = {**model.about["learned_from"], **read.contents}
        about = {**model.about, "parameters": after, "learned_from": learned_from}
        save(options.output, found.field, json_value(about))
    lines = [
        (name, f"{before[name]['value']:.4g}", *(f"{after[name][end]:.4g}" for end in ENDS), after[name]["unit"])
        for name in dict.fromkeys([*changed, *after])
    ]
    told = "; ".join(f"{name} from {old} to {new}" for name, old, new, *_ in lines[: min(3, len(changed))])
    todo = f"On logs that were not used here: hybrid-jax check {options.output} LOGS."
    shown = page.Page(
        f"What changed, by {len(logs)} logs of {options.after}, {found.seconds:.0f} s?",
        f"Changed: {told}." if changed else "Nothing changed that these logs can tell.",
        page.Table("Before, and after with 95 % intervals", HEADER, lines[:LINES]),
        [("Errors of predictions of the adapted model", figure(found.field, logs, layout))],
        warned(read, found),
        [todo if changed else "Keep the model; if something did change, fly what excites the vehicle more."],
        [
            page.Table("All parameters", HEADER, lines),
            predicted(model.field, logs, layout, "before"),
            predicted(found.field, logs, layout, "adapted"),
        ],
        [*read.said, *read.failed],
    )
    page.write(options.out, "adapt", shown, {"parameters": after, "model": options.output if changed else None})
    return 0 if changed else NOTHING_CHANGED


def check(options: Any, model: Model) -> int:
    """What it predicts of each quantity that was measured, in all logs and in each."""
    read, layout = _like(options, options.flights, model), layout_of(model.about["identified"])
    logs = [*read.logs.values()]
    whole = predicted(model.field, logs, layout, "all logs")
    ends = "; ".join(f"{name} by {error} {unit}" for name, unit, _, error in whole.lines)
    shown = page.Page(
        f"How well does {options.model.name} predict {len(logs)} logs of {options.flights}?",
        f"After {layout.dt * layout.steps:.3g} s it errs in {ends}.",
        whole,
        [("Errors of predictions, all logs", figure(model.field, logs, layout))],
        [ANYWAY.format(len(read.failed))] * bool(read.failed),
        ["Where it is wrong, learn what changed from such logs: hybrid-jax adapt."],
        [predicted(model.field, [log], layout, name) for name, log in read.logs.items()],
        [*read.said, *read.failed],
    )
    rmse = {name: error for name, _, _, error in whole.lines}
    page.write(options.out, "check", shown, {"flights": list(read.logs), "rmse": rmse})
    return 0


def _like(options: Any, folder: Path, model: Model) -> Read:
    """Logs for a model that was identified, of which none may be one that it learned from."""
    field = cast(Any, model.field)
    body = field.body if isinstance(field, Actuated) else field
    learned = tuple(name.partition("[")[0] for name in model.about["parameters"])
    read = read_checked(folder, options, body.vehicle, learned, lambda _: field)
    told = "command" if isinstance(field, Actuated) else "rotor_speed"
    for log in read.logs.values():
        if told not in log.signals:
            raise ValueError(f"{log.name}: has no {told}, which the model is told; leave it out")
    require_unseen(model.about["learned_from"], read.contents)
    return read


def _apart(one: Any, other: Any) -> bool:
    """Whether a parameter changed: intervals do not touch, and values differ by more than flights of one vehicle do."""
    # An end that is not finite is None in a file.
    low, high = (other[end] if other[end] is not None else sign * np.inf for end, sign in (("low", -1), ("high", 1)))
    return bool(one["low"] > high or one["high"] < low) and abs(one["value"] - other["value"]) > ALIKE * abs(
        other["value"]
    )
