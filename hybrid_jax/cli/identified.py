"""`hybrid-jax adapt` and `check` for identified models, which have no states."""

from pathlib import Path
from typing import Any, cast

import numpy as np

from hybrid_jax.cli import identify, page
from hybrid_jax.cli.command import NOTHING_CHANGED
from hybrid_jax.cli.identify import ENDS, LINES, STOPPED, figure, layout_of, predicted
from hybrid_jax.cli.logs import Flights, require_unseen
from hybrid_jax.dynamics.actuators import Actuated
from hybrid_jax.identification.changes import changes
from hybrid_jax.identification.fitting import window_errors
from hybrid_jax.io.files import json_value
from hybrid_jax.io.models import Model, save

KEEP = "Keep the model. If something did change, you should fly manoeuvres that excite it more."
HEADER = ("parameter", "before", "after", "from", "to", "unit")


def adapt(options: Any, model: Model) -> int:
    """Identify the model again from logs after a change, beginning with its present parameters."""
    (read, field), layout = _like(options, options.after, model), layout_of(model.about["identified"])
    logs = read.logs
    found = identify.identified(field, logs, layout)
    before, after = model.about["parameters"], identify.values_of(found)
    changed = changes(model.field, np.array(model.about["covariance"], float), found)  # null: infinite
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
    errors = {"before": window_errors(model.field, logs, layout), "adapted": window_errors(found.field, logs, layout)}
    kept = errors["adapted" if changed else "before"]
    shown = page.Page(
        f"What changed in {page.counted(logs, 'log')} of {options.after} ({found.seconds:.0f} s)?",
        f"Changed: {alone[0]}" if changed else "These logs show no change.",
        page.Table("Before, and after with 95 % intervals", HEADER, lines[:LINES]),
        [(f"Errors of predictions{' of the adapted model' * bool(changed)}", figure(kept, logs, layout.dt))],
        [*read.warnings, *[STOPPED] * (not found.converged), *alone[1:]],
        [f"On logs that were not used here: hybrid-jax check {options.output} LOGS." if changed else KEEP],
        [
            page.Table("All parameters", HEADER, lines),
            *(predicted(each, layout, name) for name, each in errors.items()),
        ],
        read.said,
    )
    told = {"parameters": after, "changed": changed, "model": options.output if changed else None}
    page.write(options.out, "adapt", shown, told)
    return 0 if changed else NOTHING_CHANGED


def check(options: Any, model: Model) -> int:
    """Compare predictions with each measured quantity, over all logs and in each."""
    (read, field), layout = _like(options, options.flights, model), layout_of(model.about["identified"])
    logs = read.logs
    errors, *each = (window_errors(field, part, layout) for part in (logs, *([log] for log in logs)))
    whole = predicted(errors, layout, "all logs")
    ends = "; ".join(f"{name} {error} {unit}" for name, unit, _, error in whole.lines)
    shown = page.Page(
        f"How well does {options.model.name} predict {page.counted(logs, 'log')} of {options.flights}?",
        f"After {layout.dt * layout.steps:.3g} s its RMS errors are: {ends}.",
        whole,
        [("Errors of predictions, all logs", figure(errors, logs, layout.dt))],
        read.warnings,
        [f"If it is wrong: hybrid-jax adapt {options.model} {options.flights} -o adapted.npz."],
        [predicted(one, layout, name) for name, one in zip(read.contents, each, strict=True)],
        read.said,
    )
    rmse = {name: error for name, _, _, error in whole.lines}
    page.write(options.out, "check", shown, {"flights": list(read.contents), "rmse": rmse})
    return 0


def _like(options: Any, folder: Path, model: Model) -> tuple[Flights, Any]:
    """Read logs for an identified model; none of them may be one of its training logs."""
    field = cast(Any, model.field)
    body = field.body if isinstance(field, Actuated) else field
    learned = tuple(name.partition("[")[0] for name in model.about["parameters"])
    read, _ = identify.read_checked(folder, options, body.vehicle, learned, lambda _: (field, ""))
    told = "command" if isinstance(field, Actuated) else "rotor_speed"
    for log in read.logs:
        if told not in log.signals:
            raise ValueError(f"{log.name}: has no {told}, which the model needs; leave it out")
    require_unseen(model.about["learned_from"], read.contents)
    return read, field
