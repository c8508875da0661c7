"""Shared parts of the programs for public records: reading, model selection on left-out parts, a table, a test."""

import csv
import dataclasses
import gzip
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import equinox as eqx
import numpy as np
import tyro
from rich.console import Console
from rich.table import Table

import hybrid_jax as hj
from experiments.runner import command


@dataclass(frozen=True)
class Options:
    """Fit physics, with and without a residual, to a record, choose by left-out parts, and predict from inputs only."""

    record: Annotated[Path, tyro.conf.Positional]
    """CSV with the columns t, u and the measured output; you may compress it with gzip."""
    test: Path | None = None
    """Another record with the same columns to predict; it is not used in the fit."""


@dataclass(frozen=True)
class Benchmark:
    """A system and its evaluation: errors are printed in `unit`, and `start` gives another record's initial state."""

    title: str
    columns: tuple[str, str]
    unit: tuple[str, float]
    candidates: Mapping[str, Callable[[], tuple[hj.StateSpaceModel, dict[str, float]]]]
    options: Mapping[str, Any]
    start: Callable[[float, hj.StateSpaceModel], tuple[float, ...]]
    hidden: tuple[float, ...]


def read(path: Path, columns: tuple[str, str]) -> hj.Record:
    """Read the record in a file; ValueError with file, row and column."""
    with gzip.open(path, "rt") if path.suffix == ".gz" else path.open() as file:
        header, *rows = csv.reader(file)
    for name in ("t", *columns):
        if name not in header:
            raise ValueError(f"{path.name}: has no column {name}; it has {', '.join(header)}")
    found = []
    for number, row in enumerate(rows, 2):
        try:
            found.append([float(row[header.index(name)]) for name in ("t", *columns)])
        except (ValueError, IndexError) as error:
            raise ValueError(f"{path.name}: row {number}: three numbers expected, got {row}") from error
    t, u, y = np.array(found).T
    return hj.Record.of(path.name, **{columns[0]: (t, u), columns[1]: (t, y)})


def main(benchmark: Benchmark, name: str, arguments: Sequence[str] | None = None) -> None:
    command.call(name, Options, lambda options: run(benchmark, options, Console()), arguments)


def run(benchmark: Benchmark, options: Options, console: Console) -> None:
    began, record = time.perf_counter(), read(options.record, benchmark.columns)
    test = None if options.test is None else read(options.test, benchmark.columns)
    table = Table("model", "left out", "this record", title=benchmark.title)
    scores, fits = {}, {}
    unit, factor = benchmark.unit
    for label, candidate in benchmark.candidates.items():
        with console.status(f"{label}: {time.perf_counter() - began:.0f} s"):
            scores[label] = [factor * error for error in left_out(benchmark, candidate, record)]
            fits[label] = fit(benchmark, *candidate(), record)
        own = factor * float(fits[label].errors[benchmark.columns[1]][0])
        table.add_row(label, ", ".join(f"{error:.3g}" for error in scores[label]), f"{own:.3g}")
    chosen = min(scores, key=lambda label: np.mean(np.square(scores[label])))
    console.print(table)
    console.print(f"RMSE of free runs in {unit}. Left out: the last third, and the first, each by a fit to the others.")
    console.print(f"Chosen: {chosen}, fitted in {time.perf_counter() - began:.0f} s with all candidates.")
    for parameter, interval in fits[chosen].intervals.items():
        low, high = float(interval.low), float(interval.high)
        console.print(f"  {parameter} {float(interval.value):.4g}, 95 % interval {low:.4g} to {high:.4g}")
    if test is not None:
        model = fits[chosen].model
        signal = test.signals[benchmark.columns[1]]
        error = free_run(benchmark, model, test, benchmark.start(float(signal.values[0, 0]), model))
        console.print(f"{test.name}: {factor * rmse(error):.4g} {unit}")


def fit(benchmark: Benchmark, model: hj.StateSpaceModel, prior: dict[str, float], record: hj.Record):
    return hj.fit_records(model, [record], prior=prior, **benchmark.options)


def free_run(benchmark: Benchmark, model: hj.StateSpaceModel, record: hj.Record, start) -> np.ndarray:
    """Return the errors of a simulation from a start, with only the inputs."""
    kept = {name: value for name, value in benchmark.options.items() if name in ("dt", "between", "substeps")}
    y = hj.simulate(model, record, start, **kept)[0][benchmark.columns[1]]
    return (y - record.signals[benchmark.columns[1]].values[: len(y)])[:, 0]


def rmse(errors: np.ndarray) -> float:
    return float(np.sqrt(np.mean(errors**2)))


def left_out(benchmark: Benchmark, candidate, record: hj.Record) -> tuple[float, float]:
    """RMSE on the last third, simulated on from a fit to the others, and on the first third.

    The initial state of the first third is estimated from its first tenth.
    """
    signal = record.signals[benchmark.columns[1]]
    begin, span = signal.t[0], signal.t[-1] - signal.t[0]
    model, prior = candidate()
    first = fit(benchmark, model, prior, record.part(begin, begin + 2 / 3 * span))
    late = signal.t > begin + 2 / 3 * span
    one = rmse(free_run(benchmark, first.model, record, first.starts[0])[late])
    at = float(np.interp(begin + span / 3, signal.t, signal.values[:, 0]))
    inside = dataclasses.replace(model, start=benchmark.start(at, model), spread=benchmark.hidden)
    second = fit(benchmark, inside, prior, record.part(begin + span / 3, np.inf))
    known = eqx.tree_at(lambda model: model.field, second.model, hj.Frozen(second.model.field))
    known = dataclasses.replace(known, start=model.start, spread=model.spread)
    start = fit(benchmark, known, {}, record.part(begin, begin + span / 30)).starts[0]
    return one, rmse(free_run(benchmark, second.model, record.part(begin, begin + span / 3), start))
