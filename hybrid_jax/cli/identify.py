"""`hybrid-jax identify`: learn a vehicle from logs of its commands and of whatever was measured beside them."""

import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import matplotlib as mpl
import numpy as np
import tyro
from jaxtyping import Float, Int
from matplotlib.figure import Figure

from hybrid_jax import checks
from hybrid_jax.cli import page
from hybrid_jax.cli.command import RARE, step
from hybrid_jax.cli.compared import check_consistent, check_whole, unlearned_drag
from hybrid_jax.cli.flags import in_flags
from hybrid_jax.cli.log_options import LogOptions, require_distinct
from hybrid_jax.cli.logs import content_of, raw_logs
from hybrid_jax.dynamics.actuators import NAMES, Actuated
from hybrid_jax.dynamics.measurement import MEASURED
from hybrid_jax.dynamics.vehicle_file import LAG, VehicleModel, load_vehicle_model
from hybrid_jax.flights.load import read_recording
from hybrid_jax.flights.recording import AXES, ROTOR_UNITS, Recording
from hybrid_jax.identification import slow_commands
from hybrid_jax.identification.fitting import Identified, identify, identify_in_turn, prediction_errors
from hybrid_jax.identification.recordings import Initial, Layout
from hybrid_jax.io.models import save

__all__ = ["LISTS", "Options", "run"]
LISTS = ("--learn", "--measured", "--motor-order", "--topics", "--test")
LINES = 5  # of what is not folded
ANYWAY = "{} checks of the logs failed, and --anyway went on: no number below counts until they pass."


@dataclass(frozen=True)
class Options(LogOptions):
    """Learn what a vehicle is from logs of its commands and of whatever was measured beside them.

    The vehicle file names what is known and, in `learn`, what is not. With commands instead of rotor speeds it needs a
    table [actuator], such as

        learn = ["curve", "time_constant", "Ix", "Iy", "delay"]
        [actuator]
        curve = [0.0, 0.0, 0.15]     # thrust of a rotor [N]: c0 + c1 command + c2 command², to start from
        gives = "thrust"             # or "speed" [rad/s]
        time_constants = 0.05        # s; or [up, down]

    Position, velocity, attitude, body rates and accelerometer may each be missing. Each parameter comes with a 95 %
    interval; one that the logs do not tell has an infinite one.

    Logs are checked first, as far as their signals allow. A check that fails stops with exit code 3; --anyway goes on.
    """

    folder: Annotated[Path, tyro.conf.Positional]
    """Folder of logs of any format that is read, or one log."""
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """File for the model."""
    vehicle: Path
    """Vehicle file (TOML)."""
    learn: tuple[str, ...] = ()
    """Names of parameters, in the place of those of the vehicle file."""
    test: tuple[Path, ...] = ()
    """Logs left out of the fit, and predicted with its result."""
    anyway: bool = False
    """Go on although checks of the logs failed: the page then says so first."""
    out: Path = Path("runs/identify")
    """Folder of the page."""
    measured: Annotated[tuple[str, ...], RARE] = ()
    """Quantities that are compared, such as rates specific_force; by default all that every log has."""
    together: Annotated[bool, RARE] = False
    """Fit all parameters at once; by default those of the thrust first, from the accelerometer, where there is one."""
    initial: Annotated[Initial, RARE] = "estimated"
    """The state that a window starts from: estimated from the samples before it, or the last sample as it is."""
    dt: Annotated[float, RARE] = 0.005
    """Steps of the solver, and of the grid on which measurements are compared [s]."""
    steps: Annotated[int, RARE] = 20
    """Steps of a window. Short ones resist slow disturbances, long ones tell slow effects."""
    windows: Annotated[int, RARE] = 300
    """Windows at most: half are those that tell most of what is learned, the others are spread evenly."""

    @property
    def layout(self) -> Layout:
        return Layout(self.dt, self.steps, self.windows, initial=self.initial)


def run(options: Options) -> int:
    for name in ("steps", "windows"):
        checks.count(f"--{name}", getattr(options, name))
    for name in options.measured:
        if name not in MEASURED:
            raise ValueError(f"--measured must be of {', '.join(MEASURED)}, got {name!r}")
    layout = options.layout
    checks.writable_folder("--out", options.out)
    checks.writable_folder("--output", options.output.parent)
    logs, left_out, field, said, failed = checked(options)
    with step(f"identifying by {len(logs)} logs") as told:
        if options.together or options.measured or not isinstance(field, Actuated):
            found = identify(field, logs, layout, options.measured)
        else:
            found = identify_in_turn(field, logs, layout)
        told(f"{found.windows} windows, {found.seconds:.4g} s of flight")
    save(options.output, found.field, {"dt": options.dt})
    shown = _page(options, found, logs, left_out, said, failed)
    units = {name: _parameter_unit(found, name) for name in found.intervals}
    parameters = {
        name: dict(zip(("value", "low", "high"), map(float, each), strict=True)) | {"unit": units[name]}
        for name, each in found.intervals.items()
    }
    page.write(options.out, "identify", shown, {"parameters": parameters, "model": options.output})
    return 0


def checked(options: Options) -> tuple[list[Recording], list[Recording], Any, list[str], list[str]]:
    """The logs to learn from, those left out, the field to start from, lines for the page, and failed checks.

    Raises:
        ChecksFailed: a check failed, without --anyway.
    """
    model, read = _model_of(options), partial(read_recording, **options.reading)
    left_out, test = [read(path) for path in options.test], {path.resolve() for path in options.test}
    raws, said = raw_logs(options.folder, lambda path: None if path.resolve() in test else read(path))
    logs = [log for _, log in raws if log is not None]
    if not logs:
        raise ValueError(f"{options.folder}: holds no log besides those of --test")
    # It could be fitted and predicted.
    named = [*((log.name, log) for log in logs), *((f"--test {log.name}", log) for log in left_out)]
    require_distinct([(name, content_of(log)) for name, log in named])
    said += [f"{Path(log.name).name}: {note}" for log in (*logs, *left_out) for note in log.notes]
    failed = check_whole([*logs, *left_out], model.vehicle, options.anyway)
    field = _field_of(options, model, logs, left_out)
    failed += check_consistent([*logs, *left_out], field, model.learn, options.anyway)
    failed = [in_flags("identify", line) for line in failed]
    for line in (*said, *failed):
        print(f"  {line}", file=sys.stderr)
    return logs, left_out, field, said, failed


def _model_of(options: Options) -> VehicleModel:
    model = load_vehicle_model(options.vehicle)
    model = replace(model, learn=options.learn) if options.learn else model
    if not model.learn:
        raise ValueError(f"{options.vehicle}: learn: names nothing; give --learn Ix Iy, or what else is not known")
    if LAG in model.learn:
        mend = _learn(model.learn, (LAG,))
        raise ValueError(f"{options.vehicle}: learn: {LAG} is for rotor speeds alone, not for commands: {mend}")
    return model


def _field_of(options: Options, model: VehicleModel, logs: list[Recording], left_out: list[Recording]):
    """The field to start from: told commands if the logs have any and the vehicle file has a table [actuator]."""
    for log in (*logs, *left_out):
        if log.rotors != model.vehicle.rotors:
            raise ValueError(f"{log.name}: has {log.rotors} motors, {options.vehicle} has {model.vehicle.rotors}")
    speeds_alone = [log.name for log in logs if "command" not in log.signals]
    told = "command" if model.actuator is not None and not speeds_alone else "rotor_speed"
    for log in logs if told == "rotor_speed" else ():
        if told not in log.signals:
            mend = f"leave out {speeds_alone[0]}" if speeds_alone else "give it a table [actuator]; see --help"
            raise ValueError(f"{options.vehicle}: {log.name} has commands and no rotor speeds: {mend}")
    for log in left_out:
        if told not in log.signals:
            raise ValueError(f"--test {log.name}: has no {told}, which the other logs have; leave it out")
    if told == "command":
        return model.commanded()
    if lost := [name for name in model.learn if name in NAMES]:
        why = f"need commands, and {speeds_alone[0]} has rotor speeds alone"
        raise ValueError(f"{options.vehicle}: learn: {', '.join(lost)}: {why}: {_learn(model.learn, lost)}")
    return model.physics()


def _learn(names: Sequence[str], without: Sequence[str]) -> str:
    """What to type to learn all but some parameters."""
    return f"give --learn {' '.join(name for name in names if name not in without) or 'Ix Iy'}"


def _page(options: Options, found: Identified, logs, left_out, said: list[str], failed: list[str]) -> page.Page:
    lines = [
        (name, *(f"{float(each):.4g}" for each in interval), _parameter_unit(found, name))
        for name, interval in found.intervals.items()
    ]
    told = [name for name, interval in found.intervals.items() if np.isfinite(float(interval[2]))]
    unseen = [name for name in found.intervals if name not in told]
    header = ("parameter", "estimate", "from", "to", "unit")
    fitted = [(name, _unit(name), "  ".join(f"{e:.3g}" for e in errors)) for name, errors in found.errors.items()]
    which = "logs left out" if left_out else "the logs fitted"
    caption = f"Errors of predictions from the state that earlier samples tell: {which}."
    again = (
        f"Fly what excites {', '.join(unseen)}, or learn less." if unseen else "Predict logs left out with --test LOG."
    )
    return page.Page(
        f"What do {len(logs)} logs of {options.folder} tell of the vehicle?",
        f"{len(told)} of {len(lines)} numbers are told by {found.seconds:.4g} s of flight.",
        page.Table("Parameters, with 95 % intervals", header, lines[:LINES]),
        [(caption, _figure(found, logs, left_out, options.layout))],
        [*([ANYWAY.format(len(failed))] if failed else []), *_notes(found, logs, unseen)],
        [again],
        [
            *([page.Table("All parameters, with 95 % intervals", header, lines)] * (len(lines) > LINES)),
            page.Table("RMS of the errors over the windows fitted", ("quantity", "unit", "x, y, z …"), fitted),
            *(_predicted(found, each, options.layout) for each in left_out),
        ],
        [*said, *failed],
    )


def _notes(found: Identified, logs: Sequence[Recording], unseen: Sequence[str]) -> list[str]:
    commands = [log.signals["command"] for log in logs if "command" in log.signals]
    slow = [signal.interval for signal in commands if slow_commands.is_slow(signal)]
    shares = ", ".join(f"{axis} {share:.2f}" for axis, share in zip("xyz", found.explained, strict=True))
    learned = {name.partition("[")[0] for name in found.intervals}
    dragged = "" if "drag" in learned else unlearned_drag(logs)
    notes = {
        f"Not told by these logs, left as they were: {', '.join(unseen)}.": unseen,
        f"Commands {max(slow, default=0):.3g} s apart: they changed in between, which the intervals count; a delay and "
        "a lag are hardly told apart by such a log.": slow,
        f"Share of the body rates within a window, less their trend, that commands explain: {shares}; inertia and "
        "torque have intervals that hold both regressions, of torque on acceleration and the other way round.": True,
        dragged: dragged,
        "The fit stopped before it converged: start nearer, or learn less.": not found.converged,
    }
    return [note for note, holds in notes.items() if holds]


def _parameter_unit(found: Identified, name: str) -> str:
    units: Any = found.field
    return units.parameter_units.get(name.partition("[")[0], "")


def _unit(name: str) -> str:
    return "rad" if name == "attitude" else AXES[name][1] if name in AXES else ROTOR_UNITS[name]


def _predicted(found: Identified, recording: Recording, layout: Layout) -> page.Table:
    errors = prediction_errors(found.field, [recording], layout, tuple(found.errors))
    asked = max(1, layout.steps // 4), layout.steps
    lines = [(name, _unit(name), *(_nearest(part, each, layout.dt) for each in asked)) for name, part in errors.items()]
    ends = [f"after {layout.dt * each:.3g} s" for each in asked]
    return page.Table(f"RMS of what was predicted of {Path(recording.name).name}", ("quantity", "unit", *ends), lines)


def _by_step(part: Float[np.ndarray, "n t k"]) -> tuple[Int[np.ndarray, " m"], Float[np.ndarray, "m k"]]:
    """The steps, from 1, at which something was measured in any window, and the RMS of the errors there."""
    steps = np.flatnonzero(~np.isnan(part).all(axis=(0, 2)))
    return steps + 1, np.sqrt(np.nanmean(part[:, steps] ** 2, axis=0))


def _nearest(part: Float[np.ndarray, "n t k"], asked: int, dt: float) -> str:
    """The errors at the measured step that is nearest to the one asked for, with its time if it is another."""
    steps, errors = _by_step(part)
    if not len(steps):
        return "not measured"
    at = int(np.abs(steps - asked).argmin())
    shown = "  ".join(f"{each:.3g}" for each in errors[at])
    return shown if steps[at] == asked else f"{shown} ({dt * steps[at]:.3g} s)"


@mpl.rc_context(page.STYLE)
def _figure(found: Identified, logs, left_out, layout: Layout) -> Figure:
    """Errors of predictions against time, of logs left out where there are any."""
    errors = prediction_errors(found.field, left_out or logs, layout, tuple(found.errors))
    picture = Figure(figsize=(3.2 * len(errors), 2.8), layout="constrained")
    for panel, (name, part) in zip(np.atleast_1d(picture.subplots(1, len(errors))), errors.items(), strict=True):
        steps, rms = _by_step(part)
        axes = logs[0].signals[name].axes if name != "attitude" else ("x", "y", "z")
        panel.plot(layout.dt * steps, rms, marker="." if len(steps) < part.shape[1] else None, label=axes)
        panel.set(xlabel="time from the start [s]", ylabel=f"RMS error [{_unit(name)}]", title=name)
        panel.legend()
    return picture
