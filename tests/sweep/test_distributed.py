"""Several processes are one run: the same rows as one process, and none is waited for when it is gone."""

import os
import shutil
import signal
import socket
import subprocess
import sys
import time

import numpy as np
import pytest
from smoke import ROOT

from experiments.reporting.report import read_record

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("all_cores")]

EXPERIMENT = ["-m", "experiments.param_shift", "--preset", "smoke", "--seeds", "3", "--models", "hybrid"]
COUNTED = ("model", "mode", "n_train", "seed", "epochs", "status")
FAST = 20.0  # s, within which the others must end when one is gone; what they do between two exchanges is part of it

# A sweep of three pendulums as a stage, on two devices for each process: its arguments are a folder, then who is who.
SWEEP = """
import sys
from pathlib import Path
sys.path.insert(0, "tests")
import jax
jax.config.update("jax_num_cpu_devices", 2)
from hybrid_jax.sweep import hosts
if len(sys.argv) > 2:
    hosts.initialize(sys.argv[2], 2, int(sys.argv[3]), timeout=10)
import numpy as np
from pendulum import DAMPING, pendulum, swings
from rich.console import Console
from experiments.runner import progress
from experiments.runner.stages import Stages
from hybrid_jax.io.files import digest, named_leaves
from hybrid_jax.io.datasets import Dataset
from hybrid_jax.sweep.lanes import stack
from hybrid_jax.training.objective import Settings
from hybrid_jax.training.fitting import make_run_config, start
progress.SECOND = 0.0
states = stack([start(pendulum(length, DAMPING), jax.random.key(i)) for i, length in enumerate((0.8, 0.7, 0.6))])
plans = stack([make_run_config(rate, np.arange(40), 40, 1, 10**6, epochs, 0.0) for rate, epochs in
               ((0.03, 6000), (0.01, 4000), (0.02, 5000))])
data = Dataset({"train": swings(40), "validation": swings(20, seed=1)}, {"config": {}})
stages = Stages(Path(sys.argv[1]), Console(stderr=True, quiet=not hosts.is_main_process()))
try:
    final = stages.sweep("a sweep", states, plans, Settings(batch_size=10), data)
except hosts.PeerLost as error:
    sys.exit(f"gone: {error}")
print("bytes", len(jax.devices()), digest("", named_leaves(final)))
"""


def address():
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return f"127.0.0.1:{free.getsockname()[1]}"


def begin(arguments, **variables):
    return subprocess.Popen([sys.executable, *arguments], cwd=ROOT, text=True, stdout=subprocess.PIPE,
                            stderr=subprocess.PIPE, env=os.environ | {"MPLBACKEND": "agg"} | variables)  # fmt: skip


def ended(processes):
    texts = [process.communicate(timeout=300) for process in processes]
    assert [process.returncode for process in processes] == [0] * len(processes), texts
    return texts


def sweep(programs, folder, *who):
    variables = {"JAX_COMPILATION_CACHE_DIR": str(programs), "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0"}
    return begin(["-c", SWEEP, str(folder), *who], **variables)


def pair(programs, folder):
    where = address()
    return [sweep(programs, folder, where, str(i)) for i in range(2)]


def experiment(out, cache, *options):
    return begin([*EXPERIMENT, "--out", str(out), "--cache", str(cache), *options])


@pytest.fixture(scope="module")
def alone(tmp_path_factory):
    """The experiment by one process, on as many devices as there are cores: its folder, with its cache."""
    folder = tmp_path_factory.mktemp("alone")
    ended([experiment(folder / "out", folder / "cache")])
    return folder


def rows(out):
    return read_record(out / "param_shift")["rows"]


def with_flights(alone, folder):
    """A cache with the flights and programs of the other run, but none of its sweeps."""
    shutil.copytree(alone / "cache", folder, ignore=shutil.ignore_patterns("sweeps"))
    return folder


def numbers(row):
    return [row["test_mse"], row["val_mse"], row["rho"], *row["theta"].values()]


def test_two_processes_find_the_rows_of_one_and_only_the_first_writes(alone, tmp_path):
    where = address()
    caches = with_flights(alone, tmp_path / "cache"), tmp_path / "other"
    both = [
        experiment(tmp_path / f"out{i}", caches[i], "--distributed", "--coordinator", where, "--processes", "2",
                   "--process-id", str(i)) for i in range(2)
    ]  # fmt: skip
    texts = ended(both)
    assert rows(tmp_path / "out0") == rows(alone / "out")
    assert not list((tmp_path / "other").glob("*"))
    assert not list((tmp_path / "out1").iterdir())
    assert "runs," in texts[0][1]
    assert "runs," not in texts[1][1]


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="cannot choose the cores of a process")
def test_one_device_finds_the_rows_of_all(alone, tmp_path):
    """To within round-off: XLA compiles for one device along another path, and sums differ in their last bit."""
    with_flights(alone, tmp_path / "cache")
    core = min(os.sched_getaffinity(0))
    one = f"import os, runpy, sys; os.sched_setaffinity(0, [{core}]); sys.argv = sys.argv[1:]; " + (
        "runpy.run_module('experiments.param_shift', run_name='__main__', alter_sys=True)"
    )
    options = [*EXPERIMENT[1:], "--out", str(tmp_path / "out"), "--cache", str(tmp_path / "cache")]
    ended([begin(["-c", one, *options])])
    for row, other in zip(rows(tmp_path / "out"), rows(alone / "out"), strict=True):
        assert {name: row[name] for name in COUNTED} == {name: other[name] for name in COUNTED}
        # Measured: up to 2e-7 after these 3 epochs.
        np.testing.assert_allclose(numbers(row), numbers(other), rtol=1e-5, atol=1e-5)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """What the pendulums' sweep ends in, by one process and never interrupted; and where its programs are kept."""
    programs = tmp_path_factory.mktemp("programs")
    ((said, _),) = ended([sweep(programs, tmp_path_factory.mktemp("whole"))])
    return said.split()[-1], programs


@pytest.mark.parametrize(("victim", "later"), [(0, (2,)), (1, (1, 2))])
def test_a_killed_process_ends_the_others_fast_and_any_number_goes_on(victim, later, whole, tmp_path):
    digest, programs = whole
    folder = tmp_path / "killed"
    folder.mkdir()
    both = pair(programs, folder)
    assert any("3 runs, epoch" in line for line in both[0].stderr)
    killed, other = both[victim], both[1 - victim]
    killed.send_signal(signal.SIGKILL)
    since = time.monotonic()
    _, said = other.communicate(timeout=60)
    assert time.monotonic() - since < FAST
    assert other.returncode == 1
    assert said.strip().splitlines()[-1] == f"gone: process {victim} has ended"
    assert len(list(folder.glob("*.begun"))) == (victim == 1)  # process 0 saves when another is lost
    for processes in later:
        left = shutil.copytree(folder, tmp_path / f"left to {processes}", dirs_exist_ok=True)
        texts = ended(pair(programs, left) if processes == 2 else [sweep(programs, left)])
        assert ("goes on where it was interrupted" in texts[0][1]) == (victim == 1)
        assert {said.split()[-1] for said, _ in texts} == {digest}
        assert all(said.split()[-2] == str(2 * processes) for said, _ in texts)


@pytest.mark.parametrize("options", [("--processes", "2"), ("--distributed",)], ids=["alone", "no cluster"])
def test_processes_that_do_not_fit_together_are_refused_in_one_line(options, tmp_path):
    process = experiment(tmp_path / "out", tmp_path / "cache", *options)
    (said,) = process.communicate(timeout=120)[1].strip().splitlines()
    assert process.returncode == 2
    assert "--distributed" in said


def test_processes_of_one_run_are_started_alike(tmp_path):
    common = "--distributed", "--coordinator", address(), "--processes", "2", "--process-id"
    both = [experiment(tmp_path / f"out{i}", tmp_path / "cache", *common, i, "--max-epochs", f"4{i}") for i in "01"]
    texts = [process.communicate(timeout=120)[1] for process in both]
    assert [process.returncode for process in both] == [2, 2]
    assert texts[0].strip().endswith("all processes must be started alike, but [1] differ from this one")
    assert texts[1].strip().endswith("this one differs from 0 in max_epochs")
