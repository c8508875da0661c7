"""The page on a folder of logs: what they hold, every check with a legend, what to do, and pictures."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from rich.console import Console

from experiments.reporting.plots import save_figures, subplots
from experiments.reporting.report import Report, write_report
from experiments.reporting.results import Results
from experiments.reporting.tables import EMPTY, Table
from experiments.runner.run_record import environment
from hybrid_jax.flights.checks.consistency import FAILS, NEED_VEHICLE, UNKNOWN, WARNS, Check
from hybrid_jax.flights.load import RawLog
from hybrid_jax.flights.recording import AXES, ROTOR_UNITS, Signal

PICTURED, POINTS = 6, 3000  # logs that get a picture; samples of each line at most
SHOWN = {FAILS: "FAILS", WARNS: "warns", UNKNOWN: "?"}
NOT_RUN = f"not checked for want of --vehicle: number of motors, largest speed; {'; '.join(NEED_VEHICLE)}"
LEGEND = {
    "whole file": "the log ends where its program ended it, and no bit was changed",
    "airframe": "a multirotor flew; a model of one stands for nothing else",
    "quantities": "position, velocity, attitude, body rates and motors, which training on states needs",
    "number of motors": "as many as the vehicle file has rotors; none is dropped in silence",
    "slowest signal": "every signal is as fast as the model's interval (--dt), before anything is interpolated",
    "longest gap": "no clock jumps; shorter gaps are kept as gaps and nothing is interpolated across them",
    "motors within limits": "commands from 0 to 1, speeds up to the vehicle's largest",
    "motors turn": "something flew",
}


@dataclass(frozen=True)
class Inspected:
    """One log: what was read, its checks, and why it is no flight for a model; empty if it is one."""

    path: Path
    raw: RawLog | None
    checks: Sequence[Check]
    refusal: str

    @property
    def result(self) -> str:
        """In a few words: refused, fails, or ready."""
        failed = [f"{check.name}: {check.suggestion}" for check in self.checks if check.verdict == FAILS]
        if self.raw is None:
            return f"not read: {printable(self.refusal.removeprefix(f'{self.path}: '))}"
        if failed:
            return f"FAILS {failed[0]}" + (f" (and {len(failed) - 1} more)" if len(failed) > 1 else "")
        return f"no flight: {self.refusal.removeprefix(f'{self.path}: ')}" if self.refusal else "ready"

    @property
    def name(self) -> str:
        """The file's name, fit to be printed."""
        return printable(self.path.name)


def printable(text: str) -> str:
    """A text that may hold a file's name, which may hold anything: with escapes for what is no character."""
    return "".join(each if each.isprintable() else repr(each)[1:-1] for each in text)


def write_page(
    out: Path, logs: Sequence[Inspected], left: Mapping[Path, str], config: Mapping[str, Any], console: Console
) -> None:
    """Write report.md, report.json, rows.csv and the figures; print the tables."""
    rows = Results([{"log": log.name, "result": log.result} for log in logs], ("log",))
    read = [log for log in logs if log.raw is not None]
    tables = [overview(logs), *([signal_table(read), check_table(read), legend(read)] if read else [])]
    tables += [todo(logs)] if todo(logs).lines else []
    notes = [f"{log.name}: {note}" for log in read if log.raw for note in log.raw.recording.notes]
    notes += [
        f"{printable(path.name)}: left: {why.replace('FILE', printable(path.name))}" for path, why in left.items()
    ]
    notes += [NOT_RUN] if config["vehicle"] is None and read else []
    pictures = {
        f"signals_{index}": (draw(log), f"{log.name}: its signals; grey: gaps")
        for index, log in enumerate(read[:PICTURED])
    }
    figures = save_figures(out, pictures)
    ready = sum(log.result == "ready" for log in logs)
    head = f"# Logs\n\n{len(logs)} logs, {ready} ready for a model; {len(left)} other files are left."
    given = ("inspect_logs", config, environment({}), rows, (), figures, notes, {}, head, tables)
    write_report(out, Report(*given))
    say = partial(console.print, highlight=False, soft_wrap=True, markup=False)
    for log in logs:
        say(f"{log.name}: {described(log)}{log.result}")
    for note in notes:
        say(f"  {note}")
    say(f"{ready} of {len(logs)} logs are ready for a model; signals, checks and what to do: {out / 'report.md'}")


def described(log: Inspected) -> str:
    """Format, vehicle, length and motors of a log that was read."""
    if log.raw is None:
        return ""
    found = log.raw.recording
    kind = found.facts.get("vehicle", "unknown vehicle")
    return f"{found.facts.get('format')}, {kind}, {found.duration:.1f} s, {found.rotors} motors: "


def overview(logs: Sequence[Inspected]) -> Table:
    lines = []
    for log in logs:
        found = log.raw.recording if log.raw else None
        facts = found.facts if found else {}
        told = (facts.get(key, EMPTY) for key in ("format", "vehicle", "airframe", "program"))
        size = (f"{found.duration:.1f}", str(found.rotors)) if found else (EMPTY, EMPTY)
        lines.append((log.name, *told, *size, log.result))
    return Table("Logs", ("log", "format", "vehicle", "airframe", "program", "s", "motors", "result"), lines)


def signal_table(logs: Sequence[Inspected]) -> Table:
    lines = []
    for log in logs:
        for name, signal in log.raw.recording.signals.items() if log.raw else ():
            rate = f"{1 / signal.interval:.4g}" if 0 < signal.interval < math.inf else EMPTY
            gaps = signal.gaps()
            longest = f", longest {max(end - start for start, end in gaps):.3g} s" if gaps else ""
            spread = f"{signal.values.min():.3g} … {signal.values.max():.3g} {unit(name)}" if len(signal) else EMPTY
            lines.append((log.name, name, signal.source, str(len(signal)), rate, f"{len(gaps)}{longest}", spread))
    header = ("log", "quantity", "from", "samples", "Hz", "gaps", "values")
    return Table("Signals at their own rates, in the library's frames and units", header, lines)


def unit(name: str) -> str:
    return ROTOR_UNITS[name] if name in ROTOR_UNITS else AXES[name][1]


def check_table(logs: Sequence[Inspected]) -> Table:
    names = list(dict.fromkeys(check.name for log in logs for check in log.checks))
    lines = []
    for log in logs:
        own = {check.name: check for check in log.checks}
        lines.append((log.name, *(_verdict(own[name]) if name in own else EMPTY for name in names)))
    return Table("Checks (? cannot tell)", ("log", *names), lines)


def _verdict(check: Check) -> str:
    told = f" {check.value:.3g} {check.unit}".rstrip() if math.isfinite(check.value) and check.unit else ""
    return f"{SHOWN.get(check.verdict, 'ok')}{told}"


def legend(logs: Sequence[Inspected]) -> Table:
    checks = {check.name: check for log in logs for check in log.checks}
    limits = {
        name: f"{check.limit:.3g} {check.unit}" if check.unit and math.isfinite(check.limit) else EMPTY
        for name, check in checks.items()
    }
    said = "two records of one motion agree: docs/howto/own_flights.md"
    return Table(
        "What the checks ask",
        ("check", "passes if", "limit"),
        [(name, LEGEND.get(name, said), limits[name]) for name in checks],
    )


def todo(logs: Sequence[Inspected]) -> Table:
    lines = []
    for log in logs:
        lines += [(log.name, c.name, c.suggestion) for c in log.checks if c.verdict in (FAILS, WARNS)]
        lines += [(log.name, "flight", log.refusal.removeprefix(f"{log.path}: "))] if log.refusal else []
    return Table("What to do", ("log", "check", "what it found, and what mends it"), lines)


def draw(log: Inspected) -> Figure:
    """A panel for each signal over time, gaps in grey."""
    signals = log.raw.recording.signals if log.raw else {}
    figure, axes = subplots((8, 1.2 + 1.3 * len(signals)), len(signals), 1, sharex=True)
    for panel, (name, signal) in zip(axes[:, 0], signals.items(), strict=True):
        step = max(1, len(signal) // POINTS)
        for axis, values in zip(signal.axes, _broken(signal, step).T, strict=True):
            panel.plot(_times(signal, step), values, linewidth=0.8, label=axis)
        for start, end in signal.gaps():
            panel.axvspan(start, end, color="0.85")
        panel.set_ylabel(f"{name.replace('_', chr(10))}\n[{unit(name)}]", fontsize=7)
        panel.legend(loc="upper right", fontsize=6, ncols=len(signal.axes))
    axes[-1, 0].set_xlabel("time [s]")
    figure.suptitle(log.name, fontsize=10, parse_math=False)
    return figure


def _times(signal: Signal, step: int) -> np.ndarray:
    return np.insert(signal.t[::step], _cuts(signal, step), [start for start, _ in signal.gaps()])


def _broken(signal: Signal, step: int) -> np.ndarray:
    """The values with a break at each gap, so that no line is drawn across it."""
    return np.insert(signal.values[::step].astype(float), _cuts(signal, step), np.nan, axis=0)


def _cuts(signal: Signal, step: int) -> np.ndarray:
    return np.searchsorted(signal.t[::step], [start for start, _ in signal.gaps()], side="right")
