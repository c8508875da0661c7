"""Shared parts of the programs for public records: reading, model selection on left-out parts, a table, a test."""

import csv
import gzip
import itertools
import os
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import tyro
from rich.console import Console
from rich.table import Table

import hybrid_jax as hj
from experiments.runner import command
from hybrid_jax.estimation import RecordFit

FIRST = 0.05  # of a record, which is in every fit: it tells the initial state
UNITS = 4


class Network(hj.AbstractVectorField):
    """A network that adds to the change of some states.

    Its hidden layer stays as drawn (Rahimi and Recht 2007), so a fit needs few steps.

    Attributes:
        weight: of each hidden unit and of 1, for each of these states.
        ranges: centre and half width of each state and input.
        sizes: index of each of these states, and the usual size of what the network adds to its derivative.
    """

    weight: jax.Array
    ranges: tuple[tuple[float, float], ...] = eqx.field(static=True)
    sizes: tuple[tuple[int, float], ...] = eqx.field(static=True)

    def __call__(self, x, u):
        centre, width = np.transpose(self.ranges)
        random, z = np.random.default_rng(0), (jnp.concatenate([x, u]) - centre) / width
        units = jnp.tanh(random.normal(size=(UNITS, len(z))) @ z + random.normal(size=UNITS))
        places, sizes = np.transpose(self.sizes)
        return jnp.zeros_like(x).at[places.astype(int)].set(sizes * (self.weight @ jnp.append(units, 1.0)))


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
    a model with its priors; each of `parts` equal parts is left out in turn. The best one then gets a `Network`, with
    the `ranges` of the states of the largest candidate and of the input, and the `sizes` by index of the state.
    """

    title: str
    columns: tuple[str, str]
    unit: tuple[str, float]
    candidates: Mapping[str, Callable[[], tuple[hj.StateSpaceModel, dict[str, float]]]]
    ranges: tuple[tuple[float, float], ...]
    sizes: dict[int, float]
    options: Mapping[str, Any]
    start: Callable[[float, float, hj.StateSpaceModel], tuple[float, ...]]
    parts: int = 5


class Tried(NamedTuple):
    """A candidate: its scores and fits without each part in turn, and its fit to the whole record, which is last."""

    scores: list[float]
    fits: list[RecordFit]
    prior: dict[str, float]


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
    tried: dict[str, Tried] = {}

    def attempt(label: str, models: Sequence[hj.StateSpaceModel], prior: dict[str, float], **own) -> None:
        with console.status(f"{label}: {time.perf_counter() - began:.0f} s"):
            tried[label] = attempted(benchmark, models, prior, record, **own)

    for label, candidate in benchmark.candidates.items():
        model, prior = candidate()
        attempt(label, [replace(model, start=begun(benchmark, model, record))] * (benchmark.parts + 1), prior)
    physics = tried[label := best(tried)]
    models = [with_network(benchmark, each.model) for each in physics.fits]
    attempt(f"{label}, and a network", models, {**physics.prior, "residual": 1.0}, starts=1, max_steps=100)
    report(benchmark, tried, time.perf_counter() - began, console)
    if test is not None:
        model, (unit, factor) = tried[best(tried)].fits[-1].model, benchmark.unit
        error = free_run(benchmark, model, test, begun(benchmark, model, test))
        console.print(f"{test.name}: {factor * rmse(error):.4g} {unit}")


def report(benchmark: Benchmark, tried: dict[str, Tried], seconds: float, console: Console) -> None:
    (unit, factor), name = benchmark.unit, benchmark.columns[1]
    table = Table("model", "left out", "this record", title=benchmark.title)
    for label, each in tried.items():
        scores = ", ".join(f"{factor * error:.3g}" for error in each.scores)
        table.add_row(label, scores, f"{factor * float(each.fits[-1].errors[name][0]):.3g}")
    console.print(table)
    console.print(f"RMSE of free runs from the start, in {unit}. Left out: each part in turn, by a fit to the others.")
    console.print(f"Chosen: {best(tried)}, fitted in {seconds:.0f} s with all candidates.")
    for parameter, interval in tried[best(tried)].fits[-1].intervals.items():
        low, high = float(interval.low), float(interval.high)
        console.print(f"  {parameter} {float(interval.value):.4g}, 95 % interval {low:.4g} to {high:.4g}")


def best(tried: dict[str, Tried]) -> str:
    return min(tried, key=lambda label: np.mean(np.square(tried[label].scores)))


def with_network(benchmark: Benchmark, model: hj.StateSpaceModel) -> hj.StateSpaceModel:
    *states, inputs = benchmark.ranges
    ranges, sizes = (*states[: len(model.start)], inputs), tuple(benchmark.sizes.items())
    return replace(model, field=hj.Hybrid(model.field, Network(jnp.zeros((len(sizes), UNITS + 1)), ranges, sizes)))


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


def attempted(benchmark: Benchmark, models, prior: dict[str, float], record: hj.Record, **options) -> Tried:
    """Score free runs of the whole record on each part by a fit, from a model of its own, to the other samples."""
    name = benchmark.columns[1]
    n = len(signal := record.signals[name])
    options = {**benchmark.options, "prior": prior, **options}
    # The last sample stays, so that all fits have one grid and one program.
    edges = np.linspace(FIRST * n, n - 1, benchmark.parts + 1).astype(int)
    parts = [np.arange(begin, end) for begin, end in itertools.pairwise(edges)]

    def fitted(model: hj.StateSpaceModel, part: np.ndarray) -> RecordFit:
        kept = replace(signal, t=np.delete(signal.t, part), values=np.delete(signal.values, part, axis=0))
        return hj.fit_records(model, [replace(record, signals={**record.signals, name: kept})], **options)

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        fits = list(pool.map(fitted, models, [*parts, parts[0][:0]]))
    runs = (free_run(benchmark, fit.model, record, fit.starts[0]) for fit in fits)
    return Tried([rmse(errors[part]) for errors, part in zip(runs, parts, strict=False)], fits, prior)
