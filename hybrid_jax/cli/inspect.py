"""The verb `hybrid-jax inspect`: check which signals logs have, advise what to log, and write a vehicle file."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import matplotlib as mpl
import numpy as np
import tyro
from matplotlib.figure import Figure

from hybrid_jax import checks
from hybrid_jax.cli import page
from hybrid_jax.cli.command import BAD_INPUT, in_flags, printable
from hybrid_jax.cli.logs import LogOptions, Looked, content_of, grouped, look, paths_of
from hybrid_jax.dynamics.vehicle_file import load_vehicle_model
from hybrid_jax.flights.checks.consistency import FAILS, NEED_VEHICLE, UNKNOWN, WARNS, Check
from hybrid_jax.flights.load import read_recording
from hybrid_jax.flights.recording import Recording, Signal, unit_of
from hybrid_jax.identification.estimates import estimate, vehicle_text
from hybrid_jax.io.files import write_atomic
from hybrid_jax.vehicle import Vehicle

__all__ = ["Options", "run"]
PICTURED, POINTS = 6, 3000  # logs that get a picture; most samples of a line
LINES = 5  # lines of a table that are not folded
# Checks that a log for a vehicle file may fail, because it does not need a position and is cut at gaps.
BORNE = ("quantities", "slowest signal", "gaps", "repeated samples")
SHOWN = {FAILS: "FAILS", WARNS: "warns", UNKNOWN: "?"}
NOT_RUN = f"Without --vehicle these are not checked: number of motors, largest speed; {'; '.join(NEED_VEHICLE)}"
EMPTY = "–"
READY = "ready"  # the result of a log that every verb accepts
LESS = "Some logs have motors, but lack states ({}). You can use hybrid-jax fit to learn what they determine."


@dataclass(frozen=True)
class Options(LogOptions):
    """Check the logs of a folder: their signals, whether they suffice for a model, and what you should log instead.

    You can inspect PX4's .ulg, logs of a Crazyflie's SD card, ROS bags, Betaflight's blackbox and CSV. Files are read
    separately, so one damaged file does not hide the others. Nothing is trained and no log is changed.

    First inspect the logs, then write a vehicle file from them, correct it by hand, and inspect the logs with it:

      hybrid-jax inspect flights/
      hybrid-jax inspect flights/ --write-vehicle v.toml --mass 0.68 --arm 0.12
      hybrid-jax inspect flights/ --vehicle v.toml
    """

    folder: Annotated[Path, tyro.conf.Positional]
    """Folder of logs, or one log."""
    vehicle: Path | None = None
    """Vehicle file to check the logs against. The number and order of motors, spin, thrust and speeds should agree."""
    write_vehicle: Path | None = None
    """Write an initial vehicle file. Hover, thrust, rotor positions, spin, lag and centre of thrust are estimated from
    logs that pass all checks; the rest is marked with a comment. Existing files are not overwritten."""
    mass: float | None = None
    """With --write-vehicle: mass [kg]. Logs cannot show it; thrust and inertia are proportional to it."""
    arm: float | None = None
    """With --write-vehicle: length of the arms [m]. Logs cannot show it; inertia scales with it."""
    dt: float = 0.01
    """Intended interval of the model [s]. A slower signal fails: half of its samples would be interpolated."""
    out: Path = Path("runs/inspect")
    """Folder for report.html and report.json."""


def run(options: Options) -> int:
    for name in ("dt", "mass", "arm"):
        if (value := getattr(options, name)) is not None:
            checks.positive(f"--{name}", value)
    if (path := options.write_vehicle) is not None:
        checks.writable_folder("--write-vehicle", path.parent)
        if path.exists():
            raise ValueError(f"--write-vehicle: {path} exists; name another file")
    vehicle = None if options.vehicle is None else load_vehicle_model(options.vehicle).vehicle
    paths, left = paths_of(options.folder)
    logs = inspected(paths, vehicle, options)
    for log in logs:
        kind = [f"{each[0]}, {each[1]}, {each[-2]} s, {each[-1]} motors: " for each in _facts(log)]
        page.say(f"{log.name}: {''.join(kind)}{warned(log)}")
    rows = [{"log": log.name, "result": result_of(log)} for log in logs]
    page.write(options.out, "inspect", _page(options, logs, [printable(line) for line in left]), {"rows": rows})
    if path is not None:
        write_vehicle(path, logs, options.folder, options.mass, options.arm)
    return BAD_INPUT if all(log.recording is None for log in logs) else 0


def result_of(log: Looked) -> str:
    """Return the result: not read, FAILS, no flight, or ready."""
    if log.recording is None:
        return f"not read: {log.problem}"
    if more := log.failed:
        rest = f" (and {len(more) - 1} more)" if len(more) > 1 else ""
        return f"FAILS {more[0].name}: {more[0].suggestion}{rest}"
    return f"no flight: {log.problem}" if log.problem else READY


def warned(log: Looked) -> str:
    """Return the result with the first check that warns, for a log that is ready."""
    result, warns = result_of(log), [check for check in log.checks if check.verdict == WARNS]
    return f"{result}; {warns[0].name} warns: {warns[0].suggestion}" if warns and result == READY else result


def inspected(paths: Sequence[Path], vehicle: Vehicle | None, options: Any) -> list[Looked]:
    """Read and check logs with the options of this verb or of `fit`; an error becomes part of the result."""
    found, first = [], {}
    for path in paths:
        name = printable(path.name)
        try:
            raw = read_recording(path, **options.reading)
        except ValueError as error:
            found.append(Looked(name, problem=printable(in_flags(str(error).removeprefix(f"{path}: ")))))
            continue
        one = look(path, raw, vehicle, options.dt, options)
        results = [replace(each, suggestion=in_flags(each.suggestion)) for each in one.checks]
        same = first.setdefault(content_of(raw), name)
        problem = in_flags(one.problem) if same == name else f"the same flight as {same}; leave one of the two out"
        found.append(one._replace(name=name, checks=results, problem=problem))
    return found


def write_vehicle(
    path: Path, logs: Sequence[Looked], folder: Path, mass: float | None = None, arm: float | None = None
) -> None:
    write_atomic(path, vehicle_text(estimate(trusted(logs)), folder.resolve().stem, mass, arm))
    print(f"{path}: written; you should read its comments before you use it")


def trusted(logs: Sequence[Looked]) -> list[Recording]:
    """Return the recordings that a vehicle file may use; print the others."""
    left = [log.name for log in logs if any(check.name not in BORNE for check in log.failed)]
    kept = [log.recording for log in logs if log.recording is not None and log.name not in left]
    if not kept:
        raise ValueError(f"vehicle file: no log of a flight passed its checks; {logs[0].name}: {result_of(logs[0])}")
    if left:
        print(f"left out of the vehicle file, as checks failed: {', '.join(left)}")
    return kept


def _page(options: Options, logs: Sequence[Looked], left: Sequence[str]) -> page.Page:
    ready = sum(result_of(log) == READY for log in logs)
    mends = [(log.name, c.name, c.suggestion) for log in logs for c in log.checks if c.verdict in (FAILS, WARNS)]
    mends += [(log.name, "no flight", log.problem) for log in logs if log.problem and not log.failed]
    learn = f"Learn from them: hybrid-jax fit {options.folder} -o source.npz --vehicle {options.vehicle or 'v.toml'}"
    read = [(log, log.recording) for log in logs if log.recording is not None]
    failed = {log.name: {check.name for check in log.failed} for log in logs}
    less = [log.name for log, raw in read if raw.rotors and {"quantities"} <= failed[log.name] <= {*BORNE}]
    worst = sorted(logs, key=lambda log: result_of(log) == READY)
    every = [(log.name, result_of(log), *(*_facts(log), (EMPTY,) * 6)[0]) for log in logs]
    return page.Page(
        f"Do the logs of {printable(str(options.folder))} suffice for a model?",
        f"{ready} of {len(logs)} logs are ready for a model.",
        page.Table("Logs", ("log", "result"), [(log.name, warned(log)) for log in worst[:LINES]]),
        [(f"{log.name}: its signals; grey: gaps", _drawn(raw)) for log, raw in read[:PICTURED]],
        [
            "Every verb reads logs that are ready, and leaves out those that fail.",
            *([LESS.format(", ".join(less))] if less else []),
            *([NOT_RUN] if options.vehicle is None and read else []),
        ],
        [learn] * bool(ready or less) + grouped(mends)[:LINES] * (not ready),
        [
            page.Table("All logs", ("log", "result", "format", "vehicle", "airframe", "program", "s", "motors"), every),
            page.Table("What to do", ("log", "check", "what it found, and what mends it"), mends),
            _signals([log for log, _ in read]),
            _checks([log for log, _ in read]),
        ],
        [*(f"{log.name}: {note}" for log in logs for note in log.notes), *left],
    )


def _facts(log: Looked) -> list[tuple[str, ...]]:
    """Return format, vehicle, airframe, program, length [s] and motors of a log."""
    if (found := log.recording) is None:
        return []
    known = {"vehicle": "unknown vehicle", **found.facts}
    facts = (str(known.get(key, EMPTY)) for key in ("format", "vehicle", "airframe", "program"))
    return [(*facts, f"{found.duration:.1f}", str(found.rotors))]


def _signals(logs: Sequence[Looked]) -> page.Table:
    lines = []
    for log in logs:
        for name, signal in log.recording.signals.items() if log.recording else ():
            rate = f"{1 / signal.interval:.4g}" if 0 < signal.interval < math.inf else EMPTY
            gaps = signal.gaps()
            longest = f", longest {max(end - start for start, end in gaps):.3g} s" if gaps else ""
            spread = f"{signal.values.min():.3g} … {signal.values.max():.3g} {unit_of(name)}" if len(signal) else EMPTY
            lines.append((log.name, name, signal.source, str(len(signal)), rate, f"{len(gaps)}{longest}", spread))
    header = ("log", "quantity", "from", "samples", "Hz", "gaps", "values")
    return page.Table("Signals at their own rates, in the library's frames and units", header, lines)


def _checks(logs: Sequence[Looked]) -> page.Table:
    def shown(check: Check) -> str:
        number = f" {check.value:.3g} {check.unit}" if check.unit and math.isfinite(check.value) else ""
        return f"{SHOWN.get(check.verdict, 'ok')}{number}"

    every = dict.fromkeys((check.name for log in logs for check in log.checks), EMPTY)
    lines = [(log.name, *(every | {each.name: shown(each) for each in log.checks}).values()) for log in logs]
    return page.Table("Checks (?: unknown; docs/howto/logs.md explains each)", ("log", *every), lines)


@mpl.rc_context(page.STYLE)
def _drawn(recording: Recording) -> Figure:
    """Plot each signal against time in its own panel, with gaps in grey."""
    figure = Figure((6.0, 0.8 + 1.1 * len(recording.signals)), layout="constrained")
    panels = figure.subplots(len(recording.signals), 1, sharex=True, squeeze=False)[:, 0]
    for panel, (name, signal) in zip(panels, recording.signals.items(), strict=True):
        panel.plot(*_broken(signal), linewidth=0.8, label=signal.axes)
        for start, end in signal.gaps():
            panel.axvspan(start, end, color="0.85")
        panel.set_ylabel(f"{name.replace('_', chr(10))}\n[{unit_of(name)}]", fontsize=8)
        panel.legend(loc="upper right", fontsize=8, ncols=len(signal.axes))
    panels[-1].set_xlabel("time [s]")
    return figure


def _broken(signal: Signal) -> tuple[np.ndarray, np.ndarray]:
    """Return times and values with a break at each gap."""
    step, starts = max(1, len(signal) // POINTS), [start for start, _ in signal.gaps()]
    t = signal.t[::step]
    cuts = np.searchsorted(t, starts, side="right")
    return np.insert(t, cuts, starts), np.insert(signal.values[::step].astype(float), cuts, np.nan, axis=0)
