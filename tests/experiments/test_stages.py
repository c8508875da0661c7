"""A sweep is run once, survives an interrupt, and is found again only by what determines it; memory stays flat."""

import gc
import os
import signal
import weakref
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path

import equinox as eqx
import jax
import numpy as np
import pytest
from filelock import FileLock
from pendulum import DAMPING, pendulum, swings
from rich.console import Console
from smoke import script

from experiments.paper.lanes import fit_of, lanes_of
from experiments.paper.tables import run_notes
from experiments.reporting.results import Results
from experiments.runner.cache import identity_of
from experiments.runner.progress import Line
from experiments.runner.run_record import OtherRun
from experiments.runner.stages import Stage, Stages, rows_of
from hybrid_jax.io.datasets import Dataset
from hybrid_jax.io.files import named_leaves
from hybrid_jax.sweep.lanes import lane, stack
from hybrid_jax.sweep.training import PROGRAMS, _block, evaluate, sweep
from hybrid_jax.training.fitting import make_run_config, start
from hybrid_jax.training.objective import Settings

SETTINGS = Settings(batch_size=10)
DATA = Dataset({"train": swings(20), "validation": swings(10, seed=1)}, {"config": {}})
STATES = stack([start(pendulum(length, DAMPING), jax.random.key(i)) for i, length in enumerate((0.8, 0.6))])
PLANS = stack([make_run_config(rate, np.arange(20), 20, 5, 100, 30, 0.0) for rate in (0.03, 0.01)])


def run(folder, states=STATES, plans=PLANS, settings=SETTINGS, data=DATA, fresh=False):
    found = Stages(folder, Console(quiet=True), fresh=fresh)
    return found.sweep("a sweep", states, plans, settings, data), found


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("stages")


@pytest.fixture(scope="module")
def whole(folder):
    return run(folder)[0]


def same(one, other):
    return eqx.tree_equal(named_leaves(one), named_leaves(other))


def test_a_finished_sweep_is_loaded_also_by_a_run_that_waited_for_another(tmp_path, whole):
    run(tmp_path)
    again, found = run(tmp_path)
    assert found.reused == ["a sweep"]
    assert same(again, whole)
    (finished,) = tmp_path.glob("*.npz")
    away = finished.rename(tmp_path / "away")
    with ThreadPoolExecutor() as pool:
        with FileLock(finished.with_suffix(".lock")):
            second = pool.submit(run, tmp_path)
            with pytest.raises(TimeoutError):
                second.result(timeout=1.0)
            away.rename(finished)
        states, stages = second.result()
    assert stages.reused == ["a sweep"]
    assert same(states, whole)


def interrupt(folder, monkeypatch):
    """Send SIGINT during the second block of epochs; returns the epochs after each block."""
    seen = []

    def show_sweep(self, progress):
        seen.append(progress.epochs)
        if len(seen) == 2:
            signal.raise_signal(signal.SIGINT)

    with monkeypatch.context() as patch:
        patch.setattr(Line, "show_sweep", show_sweep)
        with pytest.raises(KeyboardInterrupt):
            run(folder)
    return seen


@pytest.mark.usefixtures("heard")
def test_an_interrupted_sweep_goes_on_and_ends_in_the_same_bits(tmp_path, whole, monkeypatch):
    seen, later = interrupt(tmp_path, monkeypatch), []
    assert not list(tmp_path.glob("*.npz"))
    assert len(list(tmp_path.glob("*.begun"))) == 1  # the block was finished, and saved
    monkeypatch.setattr(Line, "show_sweep", lambda self, progress: later.append(progress.epochs))
    resumed, found = run(tmp_path)
    assert later[0] > seen[1]  # it did not start anew
    assert found.reused == []
    assert same(resumed, whole)
    assert not list(tmp_path.glob("*.begun"))


@pytest.mark.usefixtures("heard")
def test_a_sweep_begun_by_another_version_is_refused_and_fresh_runs_it_anew(tmp_path, whole, monkeypatch):
    interrupt(tmp_path, monkeypatch)
    (begun,) = tmp_path.glob("*.begun")
    about = tmp_path / "upgrade" / "jax-99.0.dist-info" / "METADATA"
    about.parent.mkdir(parents=True)
    about.write_text("Metadata-Version: 2.1\nName: jax\nVersion: 99.0\n")
    monkeypatch.syspath_prepend(about.parents[1])
    with pytest.raises(OtherRun, match=r"was begun with versions(.|\n)*  versions\.jax: \S+ → 99\.0\n"):
        run(tmp_path)
    assert same(run(tmp_path, fresh=True)[0], whole)
    assert list(tmp_path.glob(f"{begun.name}.before-*/*"))


@pytest.mark.parametrize(
    "other",
    [
        {"settings": replace(SETTINGS, batch_size=5)},
        {"plans": stack([make_run_config(0.02, np.arange(20), 20, 1, 1, 2, 0.0)] * 2)},
        {"data": Dataset({"train": swings(20, seed=7), "validation": swings(10, seed=1)}, {"config": {}})},
        {"states": stack([start(pendulum(length, 2 * DAMPING), jax.random.key(0)) for length in (0.8, 0.6)])},
    ],
    ids=["settings", "plans", "data", "what is static in a field"],
)
def test_anything_else_is_another_sweep(folder, whole, other):
    assert run(folder, **other)[1].reused == []


def test_a_diverged_run_stops_no_other_and_is_reported_with_its_epoch(tmp_path, whole):
    final, _ = run(tmp_path, plans=stack([lane(PLANS, 0), replace(lane(PLANS, 1), rates=np.float32(1e3))]))
    assert same(lane(final, 0), lane(whole, 0))
    rows = Results(lanes_of("parameter_shift", "physics_only", "fine_tuned", (20,), 2, fit_of(final), np.ones(2)).rows)

    assert [row["status"] == "diverged" for row in rows] == [False, True]
    assert rows[1]["epochs"] == final.epoch[1] < 30
    assert any("1 of 2 runs met a non-finite loss" in note for note in run_notes(rows))


def parts(folder, done, stop=None):
    """Four rows, one from each job; `done` has the jobs that ran."""

    def job(index):
        if index == stop:
            raise KeyboardInterrupt
        done.append(index)
        return [{"index": index, "error": np.float32(0.1) * index, "far": np.inf, "none": None}], {}

    stages = Stages(folder, Console(quiet=True))
    return rows_of(stages.kept("some parts", {str(i): partial(job, i) for i in range(4)}, identity_of(1)))


def test_finished_parts_are_kept_and_stages_run_in_order_on_what_they_need_and_compile_ahead(tmp_path):
    whole, done = parts(tmp_path / "whole", []), []
    with pytest.raises(KeyboardInterrupt):
        parts(tmp_path, [], stop=2)
    for _ in range(2):
        assert parts(tmp_path, done) == whole
        assert done == [2, 3]
    compiled = []
    one = Stage(("one",), lambda: 1)
    two = Stage(("two",), lambda found: (found + 1, [*compiled]), (one,), partial(compiled.append, "two"))
    found = Stages(tmp_path, Console(quiet=True)).run([one, two])
    assert found == {one: 1, two: (2, ["two"])}


def test_the_time_of_a_stage_within_another_counts_once(tmp_path, monkeypatch):
    stages, ticks = Stages(tmp_path, Console(quiet=True)), iter(range(4))
    monkeypatch.setattr("time.perf_counter", lambda: next(ticks))
    stages.timed("outer", lambda: stages.timed("inner", lambda: None))
    assert stages.seconds == {"outer": 2, "inner": 1}


SWEEPS, WARM = 200, 40  # caches and the allocator have settled after WARM sweeps


def resident():
    """Memory of this process in bytes, after garbage collection."""
    gc.collect()
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def soak(sizes):
    """Resident memory after the warm-up and at the end of sweeps of pendulums on so many windows in turn."""
    settings, validation = Settings(batch_size=5), swings(8, seed=1)
    for i in range(SWEEPS):
        size = sizes[i % len(sizes)]
        states = stack([start(pendulum(length, DAMPING), jax.random.key(i)) for length in (0.8, 0.6)])
        plans = stack([make_run_config(rate, np.arange(size), size, 1, 2, 6, 0.0) for rate in (0.03, 0.01)])
        final = sweep(states, plans, swings(40)[:size], validation, settings)
        evaluate(final.best, validation, 2, settings)
        if i + 1 == WARM:
            warm = resident()
    return warm, resident()


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="memory is read from Linux's /proc")
def test_memory_is_flat_after_the_warm_up():
    paths = "import sys; sys.path[:0] = ['tests', 'tests/experiments']"
    code = f"{paths}; from test_stages import soak; print(*soak([10, 15]))"
    warm, last = map(int, script("-c", code).split())
    assert last < 1.05 * warm, f"{warm / 2**20:.0f} MiB, then {last / 2**20:.0f} MiB"


def test_programs_of_old_shapes_are_freed():
    """Otherwise each shape would leave a compiled program behind."""
    settings = Settings(batch_size=7)
    kept = [weakref.ref(_block(settings, (), 1, 2, (shape,))) for shape in range(PROGRAMS + 1)]
    gc.collect()  # a map and its compiled function refer to each other
    assert [map_() is None for map_ in kept] == [True] + [False] * PROGRAMS
