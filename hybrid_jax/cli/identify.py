"""The verbs `fit`, `adapt` and `check` for logs of commands, or logs without some of the states."""

import sys
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, cast

import matplotlib as mpl
import numpy as np
from jaxtyping import Float, Int
from matplotlib.figure import Figure

from hybrid_jax import checks
from hybrid_jax.cli import page
from hybrid_jax.cli.command import NOTHING_CHANGED, ChecksFailed, in_flags, step
from hybrid_jax.cli.logs import Flights, grouped, recordings_of, require_unseen
from hybrid_jax.dynamics.actuators import NAMES, Actuated
from hybrid_jax.dynamics.vehicle_file import LAG, VehicleModel
from hybrid_jax.flights.checks.consistency import FAILS, Check
from hybrid_jax.flights.checks.suitability import check_recording
from hybrid_jax.flights.recording import Recording, unit_of
from hybrid_jax.identification import Layout, slow_commands
from hybrid_jax.identification.changes import changes
from hybrid_jax.identification.fitting import Identified, identify, identify_in_turn, measure_velocity, window_errors
from hybrid_jax.identification.learning import learnable
from hybrid_jax.identification.log_checks import compared, unlearned_drag
from hybrid_jax.io.files import json_value
from hybrid_jax.io.models import Model, save
from hybrid_jax.vehicle import Vehicle

Errors = Float[np.ndarray, "n t k"]
KEEP = "Keep the model. If something did change, you should fly manoeuvres that excite it more."
HEADER = ("parameter", "before", "after", "from", "to", "unit")
ENDS = ("value", "low", "high")
LINES = 5  # lines of a table that are not folded
FITS = ("dt", "steps", "windows", "disturbance")  # options stored in a model
NOT_NEEDED = ("quantities", "slowest signal")  # missing signals are not compared, and slow ones at their own times
STOPPED = "The fit stopped before it converged. You should start closer, or learn fewer parameters."
MEND = "nothing was identified; correct the logs as described above, or continue with --ignore-checks"
IGNORED = "{} checks of the logs failed, but --ignore-checks continued: you should not trust any number below."


def run(options: Any, path: Path, model: VehicleModel) -> int:
    """Identify a vehicle with the options of `fit`, from its file."""
    for name in ("steps", "windows"):
        checks.count(f"--{name}", getattr(options, name))
    fits = {name: getattr(options, name) for name in FITS} | {"dt": options.dt or Layout.dt}
    (read, field), layout = checked(options, path, model), layout_of(fits)
    found = identified(field, read.logs, layout)
    values = values_of(found)
    about = {"dt": layout.dt, "learned_from": read.contents, "parameters": values, "identified": fits}
    save(options.output, found.field, json_value(about | {"covariance": found.covariance}))
    shown = _page(options, found, read, layout, values)
    page.write(options.out, "fit", shown, {"parameters": values, "model": options.output})
    return 0


def layout_of(fits: Mapping[str, Any]) -> Layout:
    return Layout(fits["dt"], fits["steps"], fits["windows"], disturbance=tuple(fits["disturbance"]))


def checked(options: Any, path: Path, model: VehicleModel) -> tuple[Flights, Any]:
    """Read the logs of a folder, except those that fail checks unless --ignore-checks; also make a field."""
    if LAG in model.learn:
        advice = _learn(model.learn, (LAG,))
        raise ValueError(f"{path}: learn: {LAG} is for rotor speeds, not for commands: {advice}")
    start = partial(_field_of, path, model, (options.dt or Layout.dt) * options.steps)
    return read_checked(options.before, options, model.vehicle, model.learn, start)


def read_checked(
    folder: Path, options: Any, vehicle: Vehicle, learn: Sequence[str], start: Callable[..., tuple[Any, str]]
) -> tuple[Flights, Any]:
    """Read and check logs as `checked` does; `start` makes a field for them, and a line on what it does not learn."""
    raws, contents, notes = recordings_of(folder, options)
    failed: list[tuple[str, str, str]] = []  # a log, a check and its suggestion

    def require(checks_of: Callable[[Recording], list[Check]]) -> None:
        for name, log in [*raws.items()]:
            fails = [each for each in checks_of(log) if each.verdict == FAILS and each.name not in NOT_NEEDED]
            failed.extend((name, each.name, each.suggestion) for each in fails)
            if fails and not options.ignore_checks:
                del raws[name], contents[name]
        if not raws:
            raise ChecksFailed(*grouped(failed), MEND)

    require(lambda log: check_recording(log, vehicle))
    field, left = start([*raws.values()])
    require(lambda log: compared(log, field, learn))
    lines = [in_flags(": ".join(each)) for each in failed]
    notes += [f"{name}: {note}" for name, log in raws.items() for note in log.notes] + lines
    for line in lines:
        print(f"  {line}", file=sys.stderr)
    warnings = [IGNORED.format(len(lines))] * (bool(lines) and options.ignore_checks) + [left] * bool(left)
    return Flights([*raws.values()], contents, notes, warnings), field


def identified(field: Any, logs: Sequence[Recording], layout: Layout) -> Identified:
    """Identify the parameters, beginning with the field's; with commands, thrust comes before rotation."""
    with step(f"identifying from {page.counted(logs, 'log')}") as done:
        found = (identify_in_turn if isinstance(field, Actuated) else identify)(field, logs, layout)
        done(f"{found.windows} windows, {found.seconds:.4g} s of flight")
    return found


def values_of(found: Identified) -> dict[str, Any]:
    """Return each parameter with its interval and unit as JSON values."""
    units = cast(Any, found.field).parameter_units
    return {
        name: dict(zip(ENDS, map(float, each), strict=True)) | {"unit": units.get(name.partition("[")[0], "")}
        for name, each in found.intervals.items()
    }


def _field_of(path: Path, model: VehicleModel, window: float, logs: Sequence[Recording]) -> tuple[Any, str]:
    """Make the initial field, with commands as inputs if the logs have any and the vehicle file has [actuator]."""
    model, left = learnable(model, sum(log.duration for log in logs), window, measure_velocity(logs))
    for log in logs:
        if log.rotors != model.vehicle.rotors:
            raise ValueError(f"{log.name}: has {log.rotors} motors, {path} has {model.vehicle.rotors}")
    speeds_alone = [log.name for log in logs if "command" not in log.signals]
    if model.actuator is not None and not speeds_alone:
        return model.commanded(), left
    for log in logs:
        if "rotor_speed" not in log.signals:
            advice = f"leave out {speeds_alone[0]}" if speeds_alone else "give it a table [actuator]; see --help"
            raise ValueError(f"{path}: {log.name} has commands and no rotor speeds: {advice}")
    if lost := [name for name in model.learn if name in NAMES]:
        why = f"need commands, and {speeds_alone[0]} has only rotor speeds"
        raise ValueError(f"{path}: learn: {', '.join(lost)}: {why}: {_learn(model.learn, lost)}")
    return model.physics(), left


def _learn(names: Sequence[str], without: Sequence[str]) -> str:
    """Return the option that learns all but some parameters."""
    return f"give --learn {' '.join(name for name in names if name not in without) or 'Ix Iy'}"


def _page(options: Any, found: Identified, read: Flights, layout: Layout, values: Mapping[str, Any]) -> page.Page:
    lines = [(name, *(f"{one[end]:.4g}" for end in ENDS), one["unit"]) for name, one in values.items()]
    unseen = [name for name, one in values.items() if not np.isfinite(one["high"])]
    header = ("parameter", "estimate", "from", "to", "unit")
    fitted = [(name, _unit(name), "  ".join(f"{e:.3g}" for e in each)) for name, each in found.errors.items()]
    again = f"On logs that were not used here: hybrid-jax check {options.output} LOGS."
    errors = window_errors(found.field, read.logs, layout)
    return page.Page(
        f"What do {page.counted(read.logs, 'log')} of {options.before} show about the vehicle?",
        f"{len(values) - len(unseen)} of {len(lines)} parameters are identified by {found.seconds:.4g} s of flight.",
        page.Table("Parameters, with 95 % intervals", header, lines[:LINES]),
        [("Errors of predictions from the state estimated from earlier samples", figure(errors, read.logs, layout.dt))],
        [*read.warnings, *_notes(found, read.logs, unseen)],
        [f"You should excite {', '.join(unseen)} more, or learn fewer parameters." if unseen else again],
        [
            *([page.Table("All parameters, with 95 % intervals", header, lines)] * (len(lines) > LINES)),
            page.Table("RMS of the errors over the windows fitted", ("quantity", "unit", "x, y, z …"), fitted),
        ],
        read.notes,
    )


def _notes(found: Identified, logs: Sequence[Recording], unseen: Sequence[str]) -> list[str]:
    commands = [log.signals["command"] for log in logs if "command" in log.signals]
    slow = [signal.interval for signal in commands if slow_commands.is_slow(signal)]
    shares = ", ".join(f"{axis} {share:.2f}" for axis, share in zip("xyz", found.explained, strict=True))
    learned = {name.partition("[")[0] for name in found.intervals}
    notes = {
        STOPPED: not found.converged,
        f"Not identifiable from these logs, unchanged: {', '.join(unseen)}.": unseen,
        f"Commands are {max(slow, default=0):.3g} s apart. The intervals include changes in between, and a delay and a "
        "lag can hardly be distinguished.": slow,
        f"Share of the changes of the body rates that the motors explain: {shares}. If it is small, the intervals of "
        "inertia and torque are wide.": True,
        ("" if "drag" in learned else unlearned_drag(logs)): True,
    }
    return [note for note, holds in notes.items() if note and holds]


def _unit(name: str) -> str:
    return "rad" if name == "attitude" else unit_of(name)


def predicted(errors: Mapping[str, Errors], layout: Layout, what: str) -> page.Table:
    asked = max(1, layout.steps // 4), layout.steps
    lines = [(name, _unit(name), *(_nearest(part, each, layout.dt) for each in asked)) for name, part in errors.items()]
    ends = [f"after {layout.dt * each:.3g} s" for each in asked]
    return page.Table(f"RMS of what was predicted: {what}", ("quantity", "unit", *ends), lines)


def _by_step(part: Errors) -> tuple[Int[np.ndarray, " m"], Float[np.ndarray, "m k"]]:
    """Return the steps, from 1, with a measurement in any window, and the RMS errors there."""
    steps = np.flatnonzero(~np.isnan(part).all(axis=(0, 2)))
    return steps + 1, np.sqrt(np.nanmean(part[:, steps] ** 2, axis=0))


def _nearest(part: Errors, asked: int, dt: float) -> str:
    """Return the errors at the measured step nearest to the requested one, with its time if it differs."""
    steps, errors = _by_step(part)
    if not len(steps):
        return "not measured"
    at = int(np.abs(steps - asked).argmin())
    shown = "  ".join(f"{each:.3g}" for each in errors[at])
    return shown if steps[at] == asked else f"{shown} ({dt * steps[at]:.3g} s)"


@mpl.rc_context(page.STYLE)
def figure(errors: Mapping[str, Errors], logs: Sequence[Recording], dt: float) -> Figure:
    rows = -(-len(errors) // 2)
    picture = Figure(figsize=(6.0, 2.6 * rows), layout="constrained")
    for i, (name, part) in enumerate(errors.items(), 1):
        panel = picture.add_subplot(rows, min(2, len(errors)), i)
        steps, rms = _by_step(part)
        axes = logs[0].signals[name].axes if name != "attitude" else ("x", "y", "z")
        panel.plot(dt * steps, rms, marker="." if len(steps) < part.shape[1] else None, label=axes)
        panel.set(xlabel="time from the start [s]", ylabel=f"RMS error [{_unit(name)}]", title=name)
        panel.legend()
    return picture


def adapt(options: Any, model: Model) -> int:
    """Identify the model again from logs after a change, beginning with its present parameters."""
    (read, field), layout = _like(options, options.after, model), layout_of(model.about["identified"])
    logs = read.logs
    found = identified(field, logs, layout)
    before, after = model.about["parameters"], values_of(found)
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
        f"{share:.0%} of the difference of these logs."
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
        [page.Table("All parameters", HEADER, lines), *(predicted(one, layout, name) for name, one in errors.items())],
        read.notes,
    )
    record = {"parameters": after, "changed": changed, "model": options.output if changed else None}
    page.write(options.out, "adapt", shown, record)
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
        read.notes,
    )
    rmse = {name: error for name, _, _, error in whole.lines}
    page.write(options.out, "check", shown, {"flights": list(read.contents), "rmse": rmse})
    return 0


def _like(options: Any, folder: Path, model: Model) -> tuple[Flights, Any]:
    """Read logs for an identified model; ValueError if one of them is a training log."""
    field = cast(Any, model.field)
    body = field.body if isinstance(field, Actuated) else field
    learned = tuple(name.partition("[")[0] for name in model.about["parameters"])
    read, _ = read_checked(folder, options, body.vehicle, learned, lambda _: (field, ""))
    motors = "command" if isinstance(field, Actuated) else "rotor_speed"
    for log in read.logs:
        if motors not in log.signals:
            raise ValueError(f"{log.name}: has no {motors}, which the model needs; leave it out")
    require_unseen(model.about["learned_from"], read.contents)
    return read, field
