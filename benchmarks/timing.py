"""What every benchmark does alike: compile apart, compare results, time in turns, print tables, write JSON.

The calls that are compared take turns, so that a busy moment of the machine hits all alike, and what counts is the
median. A ratio of two calls is the median of the ratios within each turn. Set the cores with taskset.
"""

import os
import statistics
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import jax
import numpy as np
import tyro
from jaxtyping import PyTree
from matplotlib.figure import Figure
from rich.console import Console
from rich.table import Table

from experiments.paper.figures import save_figure
from experiments.reporting.environment import environment
from experiments.runner.command import BAD_INPUT, check_folder
from hybrid_jax.io.files import json_text, write_atomic
from hybrid_jax.runtime import PROGRAMS, configure, cores

Call = Callable[[], Any]
DISAGREEMENT = 1  # exit code


class Disagreement(RuntimeError):
    """Two programs that were to be timed against each other do not compute the same."""


@dataclass(frozen=True)
class Options:
    """What to measure and where to write it."""

    preset: str = "full"
    """full: what is reported. smoke: does it work, in seconds; its numbers say nothing."""
    out: Path | None = None
    """Also write the numbers to this file as JSON, and a figure, if there is one, beside it."""


@dataclass(frozen=True)
class Ratio:
    """One number to keep an eye on, and what it should reach."""

    what: str
    value: float
    at_most: float | None = None
    at_least: float | None = None

    @property
    def holds(self) -> bool | None:
        """Whether it is reached; None where nothing is asked for."""
        if self.at_most is None and self.at_least is None:
            return None
        return (self.at_most is None or self.value <= self.at_most) and (
            self.at_least is None or self.value >= self.at_least
        )


@dataclass(frozen=True)
class Findings:
    """What a benchmark measured: rows of JSON values, the same for reading, the ratios that matter, and a figure."""

    rows: list[dict[str, Any]]
    tables: list[Table]
    ratios: list[Ratio] = field(default_factory=list)
    figure: Figure | None = None


@dataclass(frozen=True)
class Times:
    """Seconds of each call in each turn."""

    seconds: Mapping[Any, Sequence[float]]

    def median(self, name: Any) -> float:
        """Of one call [s]."""
        return statistics.median(self.seconds[name])

    def medians(self) -> dict[Any, float]:
        """Of every call [s]."""
        return {name: self.median(name) for name in self.seconds}

    def ratio(self, name: Any, other: Any) -> float:
        """How many times as long as the other a call takes: the median over the turns."""
        return statistics.median(a / b for a, b in zip(self.seconds[name], self.seconds[other], strict=True))


def stopwatch(call: Callable[[], Any]) -> tuple[Any, float]:
    """What the call returns, once it is computed, and the seconds that took."""
    before = time.perf_counter()
    result = jax.block_until_ready(call())
    return result, time.perf_counter() - before


def in_turns(calls: Mapping[Any, Call], turns: int) -> Times:
    """Time each call once a turn, forwards and backwards by turns. Call each once before: this warms nothing up."""
    taken: dict[Any, list[float]] = {name: [] for name in calls}
    for turn in range(turns):
        for name in list(calls)[:: -1 if turn % 2 else 1]:
            taken[name].append(stopwatch(calls[name])[1])
    return Times(taken)


def compiled(function: Callable[..., PyTree], *arguments: PyTree) -> tuple[Call, float]:
    """A call of the compiled function on arguments that lie on the device, and the seconds of tracing and compiling."""
    call, seconds, _ = compiled_with_memory(function, *arguments)
    return call, seconds


def compiled_with_memory(function: Callable[..., PyTree], *arguments: PyTree) -> tuple[Call, float, int]:
    """As `compiled`, and the bytes that the program needs beside its arguments and results."""
    arguments = jax.device_put(arguments)
    program, seconds = stopwatch(lambda: jax.jit(function).lower(*arguments).compile())
    return lambda: program(*arguments), seconds, program.memory_analysis().temp_size_in_bytes


def repeated(call: Call, turns: int, budget: float) -> float:
    """The median seconds of a call, after one that warms up; fewer turns, but three, once the budget [s] is spent."""
    call()
    taken: list[float] = []
    while len(taken) < turns and (len(taken) < 3 or sum(taken) < budget):
        taken.append(stopwatch(call)[1])
    return statistics.median(taken)


def agree(what: str, ours: PyTree, theirs: PyTree, tolerance: float) -> float:
    """The largest difference of any two arrays, relative to the largest number in the second.

    Raises:
        Disagreement: it exceeds the tolerance, or is not a number.
    """
    pairs = zip(jax.tree.leaves(ours), jax.tree.leaves(theirs), strict=True)
    differences = [float(np.max(np.abs(np.asarray(a) - b)) / max(np.max(np.abs(b)), 1e-30)) for a, b in pairs]
    worst = float(np.max(differences))
    if not worst <= tolerance:
        raise Disagreement(f"{what} differ by {worst:.1e}, allowed {tolerance:.0e}")
    return worst


def run(name: str, about: str | None, presets: Mapping[str, Any], measure: Callable[[Any], Findings]) -> None:
    """The command line: measure a preset, print, write. Bad input ends in one line on stderr and exit code 2."""
    options = tyro.cli(Options, prog=f"python -m benchmarks.{name}", description=about)
    try:
        _check(options, presets)
    except ValueError as error:
        _end(name, error, BAD_INPUT)
    began = time.perf_counter()
    # An empty cache, so that every compilation that is timed is one.
    os.environ.pop(PROGRAMS, None)
    with TemporaryDirectory() as cache:
        configure(Path(cache))
        try:
            findings = measure(presets[options.preset])
        except Disagreement as error:
            _end(name, error, DISAGREEMENT)
    _print(findings, Console())
    if options.out is not None:
        report = _report(name, options.preset, findings, time.perf_counter() - began)
        write_atomic(options.out, json_text(report))
        if findings.figure is not None:
            save_figure(findings.figure, options.out.with_suffix(""))


def _check(options: Options, presets: Mapping[str, Any]) -> None:
    if options.preset not in presets:
        raise ValueError(f"--preset must be one of {', '.join(presets)}, got {options.preset!r}")
    if options.out is None:
        return
    if options.out.is_dir():
        raise ValueError(f"--out {options.out}: is a folder, a file is wanted")
    check_folder("--out", options.out.parent)


def _end(name: str, error: Exception, code: int):
    print(f"{name}: {' '.join(str(error).split())}", file=sys.stderr)
    sys.exit(code)


def _print(findings: Findings, console: Console) -> None:
    for table in findings.tables:
        console.print(table)
    if findings.ratios:
        console.print(ratio_table(findings.ratios))


def ratio_table(ratios: Sequence[Ratio]) -> Table:
    """What is reached and what is not."""
    table = Table("ratio", "", "reach", "", title=f"on {cores()} cores")
    for ratio in ratios:
        bounds = (("≤", ratio.at_most), ("≥", ratio.at_least))
        reach = ", ".join(f"{sign} {bound:g}" for sign, bound in bounds if bound is not None)
        verdict = {None: "", True: "reached", False: "not reached"}[ratio.holds]
        table.add_row(ratio.what, f"{ratio.value:.3g}", reach, verdict)
    return table


def _report(name: str, preset: str, findings: Findings, seconds: float) -> dict[str, Any]:
    return {
        "benchmark": name,
        "preset": preset,
        "environment": environment({name: seconds}),
        "cores_used": cores(),
        "rows": findings.rows,
        "ratios": [asdict(ratio) | {"holds": ratio.holds} for ratio in findings.ratios],
    }
