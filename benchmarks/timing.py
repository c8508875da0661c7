"""Shared by all benchmarks: compile separately, compare results, time in turns, print tables, write JSON.

Calls that are compared take turns, so that load on the machine affects all of them, and medians are reported. A ratio
of two calls is the median of the ratios within each turn. Set the cores with taskset.
"""

import math
import os
import statistics
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any, Literal

import jax
import numpy as np
import tyro
from jaxtyping import PyTree
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from hybrid_jax import checks
from hybrid_jax.cli.command import exit_codes, parsed
from hybrid_jax.io.datasets import versions
from hybrid_jax.io.files import json_text, write_atomic
from hybrid_jax.runtime import PROGRAMS, configure, cores, hardware

Call = Callable[[], Any]
DISAGREEMENT = 1  # exit code
PACKAGES = ("jax", "jaxlib", "equinox", "diffrax", "optax", "mujoco", "mujoco-mjx", "numpy", "hybrid_jax")


class Disagreement(RuntimeError):
    """Two programs to be compared do not compute the same."""


@dataclass(frozen=True)
class Options:
    """Measure one benchmark."""

    preset: Literal["full", "smoke"] = "full"
    """The reported numbers, or a functional check in seconds whose numbers mean nothing."""
    output: Annotated[Path | None, tyro.conf.arg(aliases=["-o"])] = None
    """Also write the numbers to this file as JSON."""


@dataclass(frozen=True)
class Ratio:
    """A measured number and its bounds."""

    what: str
    value: float
    at_most: float | None = None
    at_least: float | None = None

    @property
    def holds(self) -> bool | None:
        """Whether the bounds hold; None without bounds."""
        if self.at_most is None and self.at_least is None:
            return None
        low, high = (-math.inf if self.at_least is None else self.at_least), self.at_most
        return low <= self.value <= (math.inf if high is None else high)


@dataclass(frozen=True)
class Findings:
    """The results of a benchmark: rows of JSON values, tables of the same, and ratios."""

    rows: list[dict[str, Any]]
    tables: list[Table]
    ratios: list[Ratio] = field(default_factory=list)


@dataclass(frozen=True)
class Times:
    """Seconds of each call in each turn."""

    seconds: Mapping[Any, Sequence[float]]

    def median(self, name: Any) -> float:
        """The median of one call [s]."""
        return statistics.median(self.seconds[name])

    def ratio(self, name: Any, other: Any) -> float:
        """The time of a call over that of another: the median over the turns."""
        return statistics.median(a / b for a, b in zip(self.seconds[name], self.seconds[other], strict=True))


def stopwatch(call: Callable[[], Any], clock: Callable[[], float] = time.perf_counter) -> tuple[Any, float]:
    """The result of a call, once computed, and its duration [s]."""
    before = clock()
    result = jax.block_until_ready(call())
    return result, clock() - before


def in_turns(calls: Mapping[Any, Call], turns: int, *, warm: bool = False, clock=time.perf_counter) -> Times:
    """Time each call once per turn, in alternating order. Call each once before.

    Args:
        warm: call each once more in every turn before it is timed, for work that usually goes on for long: a call of
            milliseconds after another program's seconds took up to three times as long.
        clock: `time.process_time` on one core of a machine on which other programs run.
    """
    taken: dict[Any, list[float]] = {name: [] for name in calls}
    for turn in range(turns):
        for name in list(calls)[:: -1 if turn % 2 else 1]:
            if warm:
                jax.block_until_ready(calls[name]())
            taken[name].append(stopwatch(calls[name], clock)[1])
    return Times(taken)


def compiled(function: Callable[..., PyTree], *arguments: PyTree) -> tuple[Call, float]:
    """A call of the compiled function on device arrays, and the seconds of tracing and compiling."""
    return compiled_with_memory(function, *arguments)[:2]


def compiled_with_memory(function: Callable[..., PyTree], *arguments: PyTree) -> tuple[Call, float, int]:
    """As `compiled`, and the bytes that the program needs besides its arguments and results."""
    arguments = jax.device_put(arguments)
    program, seconds = stopwatch(lambda: jax.jit(function).lower(*arguments).compile())
    return lambda: program(*arguments), seconds, program.memory_analysis().temp_size_in_bytes


def agree(what: str, ours: PyTree, theirs: PyTree, tolerance: float) -> float:
    """The largest difference of any two arrays, relative to the largest number in the second.

    Raises:
        Disagreement: it exceeds the tolerance, or is not a number.
    """
    pairs = zip(jax.tree.leaves(ours), jax.tree.leaves(theirs), strict=True)
    sizes = [[np.max(np.abs(part), initial=0) for part in (np.asarray(a) - b, b)] for a, b in pairs]
    worst = float(np.max([off / max(size, 1e-30) for off, size in sizes]))
    if not worst <= tolerance:
        raise Disagreement(f"{what} differ by {worst:.1e}, allowed {tolerance:.0e}")
    return worst


def run(
    name: str, about: str | None, presets: Mapping[str, Any], measure: Callable[..., Findings], kind: type = Options
) -> None:
    """The command line: measure a preset, print, write. Bad input ends in one line on stderr and exit code 2.

    Options of a kind beyond `Options` go to `measure` by name.
    """
    with exit_codes(name, name, "interrupted, nothing was written"):
        _run(name, parsed(kind, f"python -m benchmarks.{name}", None, description=about or ""), presets, measure)


def _run(name: str, options: Any, presets: Mapping[str, Any], measure: Callable[..., Findings]) -> None:
    check_file("--output", options.output)
    began = time.perf_counter()
    # An empty cache, so that timed compilations are real.
    os.environ.pop(PROGRAMS, None)
    with TemporaryDirectory() as cache:
        configure(Path(cache))
        try:
            more = {key: value for key, value in vars(options).items() if key not in ("preset", "output")}
            findings = measure(presets[options.preset], **more)
        except Disagreement as error:
            print(f"{name}: {error}", file=sys.stderr)
            sys.exit(DISAGREEMENT)
    seconds, console = time.perf_counter() - began, Console()
    for printed in [*findings.tables, *([ratio_table(findings.ratios)] if findings.ratios else [])]:
        console.print(printed)
    if options.output is None:
        return
    report = {
        "benchmark": name,
        "preset": options.preset,
        "environment": {
            "date": datetime.now(UTC).isoformat(timespec="seconds"),
            "versions": versions(*PACKAGES),
            "hardware": hardware(),
            "seconds": {name: round(seconds, 3)},
        },
        "cores_used": cores(),
        "rows": findings.rows,
        "ratios": [asdict(ratio) | {"holds": ratio.holds} for ratio in findings.ratios],
    }
    write_atomic(options.output, json_text(report))


def check_file(option: str, file: Path | None) -> None:
    """Require a file that can be written, before work begins; its folder is created."""

    if file is None:
        return
    if file.is_dir():
        raise ValueError(f"{option} {file}: is a folder, a file is needed")
    checks.writable_folder(option, file.parent)


def table(title: str, rows: Sequence[Any], columns: Mapping[str, Callable[[Any], str]]) -> Table:
    """Rows for reading; each column is named by its head and made of a row."""
    made = Table(*map(escape, columns), title=title)  # or [ms] would be taken for a style
    for row in rows:
        made.add_row(*(cell(row) for cell in columns.values()))
    return made


def ratio_table(ratios: Sequence[Ratio]) -> Table:
    """Ratios and their bounds."""

    def reach(ratio: Ratio) -> str:
        bounds = (("≤", ratio.at_most), ("≥", ratio.at_least))
        return ", ".join(f"{sign} {bound:g}" for sign, bound in bounds if bound is not None)

    verdicts = {None: "", True: "reached", False: "not reached"}
    columns = {
        "ratio": lambda ratio: ratio.what,
        "": lambda ratio: f"{ratio.value:.3g}",
        "reach": reach,
        " ": lambda ratio: verdicts[ratio.holds],
    }
    return table(f"on {cores()} core{'s' * (cores() > 1)}", ratios, columns)
