"""Shared parts of the programs for public records: reading, model selection on left-out parts, a table, a test."""

import csv
import gzip
import itertools
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro
from rich.console import Console
from rich.table import Table

import hybrid_jax as hj
from experiments.runner import command

FIRST = 0.05  # of a record, which is in every fit: it tells the initial state


@dataclass(frozen=True)
class Options:
    """Fit several models to a record, choose by left-out parts, and predict another record from its inputs only."""

    record: Annotated[Path, tyro.conf.Positional]
    """CSV with the columns t, u and the measured output; you may compress it with gzip."""
    test: Path | None = None
    """Another record with the same columns to predict; it is not used in the fit."""


@dataclass(frozen=True)
class Benchmark:
    """A system and its evaluation.

    Errors are printed in `unit`, and `start` gives the initial state from the first samples and a model. A candidate is
    a model with its priors; each of `parts` equal parts is left out in turn.
    """

    title: str
    columns: tuple[str, str]
    unit: tuple[str, float]
    candidates: Mapping[str, Callable[[], tuple[hj.StateSpaceModel, dict[str, float]]]]
    options: Mapping[str, Any]
    start: Callable[[float, float, hj.StateSpaceModel], tuple[float, ...]]
    parts: int = 5


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
        model, prior = candidate()
        model = replace(model, start=begun(benchmark, model, record))
        with console.status(f"{label}: {time.perf_counter() - began:.0f} s"):
            scores[label] = [factor * error for error in left_out(benchmark, model, prior, record)]
            fits[label] = fit(benchmark, model, prior, record)
        own = factor * float(fits[label].errors[benchmark.columns[1]][0])
        table.add_row(label, ", ".join(f"{error:.3g}" for error in scores[label]), f"{own:.3g}")
    chosen = min(scores, key=lambda label: np.mean(np.square(scores[label])))
    console.print(table)
    console.print(f"RMSE of free runs from the start, in {unit}. Left out: each part in turn, by a fit to the others.")
    console.print(f"Chosen: {chosen}, fitted in {time.perf_counter() - began:.0f} s with all candidates.")
    for parameter, interval in fits[chosen].intervals.items():
        low, high = float(interval.low), float(interval.high)
        console.print(f"  {parameter} {float(interval.value):.4g}, 95 % interval {low:.4g} to {high:.4g}")
    if test is not None:
        model = fits[chosen].model
        error = free_run(benchmark, model, test, begun(benchmark, model, test))
        console.print(f"{test.name}: {factor * rmse(error):.4g} {unit}")


def fit(benchmark: Benchmark, model: hj.StateSpaceModel, prior: dict[str, float], record: hj.Record):
    return hj.fit_records(model, [record], prior=prior, **benchmark.options)


def free_run(benchmark: Benchmark, model: hj.StateSpaceModel, record: hj.Record, start) -> np.ndarray:
    """Return the errors of a simulation from a start, with only the inputs."""
    kept = {name: value for name, value in benchmark.options.items() if name in ("dt", "between", "substeps")}
    y = hj.simulate(model, record, start, **kept)[0][benchmark.columns[1]]
    return (y - record.signals[benchmark.columns[1]].values[: len(y)])[:, 0]


def begun(benchmark: Benchmark, model: hj.StateSpaceModel, record: hj.Record) -> tuple[float, ...]:
    u, y = (float(record.signals[name].values[0, 0]) for name in benchmark.columns)
    return benchmark.start(u, y, model)


def rmse(errors: np.ndarray) -> float:
    return float(np.sqrt(np.mean(errors**2)))


def left_out(benchmark: Benchmark, model: hj.StateSpaceModel, prior: dict[str, float], record: hj.Record):
    """Return the RMSE of free runs of the whole record on each part, by a fit to the other samples."""
    name, found = benchmark.columns[1], []
    n = len(signal := record.signals[name])
    # The last sample stays, so that all fits have one grid and one program.
    for begin, end in itertools.pairwise(np.linspace(FIRST * n, n - 1, benchmark.parts + 1).astype(int)):
        others = np.delete(np.arange(n), np.s_[begin:end])
        kept = replace(signal, t=signal.t[others], values=signal.values[others])
        result = fit(benchmark, model, prior, replace(record, signals={**record.signals, name: kept}))
        found.append(rmse(free_run(benchmark, result.model, record, result.starts[0])[begin:end]))
    return found
