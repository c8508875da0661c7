"""Real commands, killed, starved and given other inputs, lose nothing. See docs/notes/reliability.md."""

import json
import os
import random
import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
KILLS = int(os.environ.get("HYBRID_JAX_KILLS", "3"))
EPOCHS = "300"
TRIES = 5
SMALL = [
    "--preset", "smoke", "--models", "hybrid", "--checkpoint-share", "1", "--max-epochs", EPOCHS,
    "--patience.hybrid-pretraining.minimum", EPOCHS, "--patience.hybrid-minimum", *[EPOCHS] * 5,
]  # fmt: skip
MOMENTS = ("checkpoint", "pre-training", "adaptation", "data", "report")


class Place:
    """A cache and a folder of results; every test begins with flights and compiled programs in it, and no more."""

    def __init__(self, folder):
        self.cache, self.out = folder / "cache", folder / "out"
        self.results = self.out / "param_shift"

    def clear(self, flights=False):
        shutil.rmtree(self.cache / "stages", ignore_errors=True)
        shutil.rmtree(self.out, ignore_errors=True)
        for path in self.cache.glob("flights-*.npz") if flights else ():
            path.unlink()

    def command(self, *options):
        run = [sys.executable, "-m", "experiments.param_shift", *SMALL, *options]
        return [*run, "--out", str(self.out), "--cache", str(self.cache)]

    def begin(self):
        return subprocess.Popen(self.command(), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, cwd=ROOT)

    def run(self, *options, prefix=()):
        return subprocess.run([*prefix, *self.command(*options)], capture_output=True, text=True, cwd=ROOT)

    def read(self, name):
        return json.loads((self.results / name).read_text())

    def stage(self):
        """The stage in which a run is, by the files that exist."""
        if not (self.results / "run.json").exists():
            return "start"
        if len(list(self.cache.glob("flights-*.npz"))) < 2:
            return "data"
        sweeps = len(list(self.cache.glob("stages/*.npz")))
        return "report" if sweeps == 3 else "adaptation" if sweeps else "pre-training"

    def writes(self):
        """A checkpoint is being written."""
        return any(self.cache.glob("stages/*.begun/.*.part"))

    def checkpoints(self):
        try:
            return sorted(self.cache.glob("stages/*.begun/*.npz"))
        except FileNotFoundError:  # the sweep has ended meanwhile
            return []


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    return Place(tmp_path_factory.mktemp("reliability"))


@pytest.fixture(scope="module")
def whole(place):
    done = place.run()
    assert done.returncode == 0, done.stderr
    assert place.read("run.json")["state"] == "finished"
    return place.read("report.json")["rows"]


def kill(place, due, delay=0.0, flights=False):
    """Start the command on a clean place and kill -9 it this long after `due()`; whether its run had not finished."""
    place.clear(flights)
    with place.begin() as process:
        while process.poll() is None and not due():
            time.sleep(0.0005)
        time.sleep(delay)
        process.kill()
    return process.returncode == -9 and place.read("run.json")["state"] == "unfinished"


@pytest.mark.slow
def test_a_killed_run_survives_other_inputs_a_full_disk_and_a_truncated_checkpoint(place, whole):
    for _ in range(TRIES):  # a busy machine may see the checkpoints only after the end
        if kill(place, lambda: len(place.checkpoints()) == 2) and len(place.checkpoints()) == 2:
            break
    record, saved = place.read("run.json"), {path: path.read_bytes() for path in place.checkpoints()}
    assert (record["state"], len(saved)) == ("unfinished", 2)

    other = place.run("--regulariser-weight", "0.01")
    assert other.returncode == 2
    assert f"holds an unfinished run, begun {record['started']}, that differs:" in other.stderr
    assert "  config.regulariser_weight: 0.001 → 0.01\n" in other.stderr
    assert "--restart" in other.stderr

    # No file may grow beyond 6 blocks of 512 bytes: the next checkpoint cannot be written, as on a full disk.
    full = place.run(prefix=["sh", "-c", 'ulimit -f 6; exec "$@"', "sh"])
    assert full.returncode == 2, full.stderr
    (line,) = [line for line in full.stderr.splitlines() if "cannot be saved" in line]
    assert "what was saved before is intact" in line
    assert "Traceback" not in full.stderr
    assert place.read("run.json") == record
    assert {path: path.read_bytes() for path in place.checkpoints()} == saved

    last = max(saved)
    os.truncate(last, last.stat().st_size // 2)
    again = place.run()
    assert again.returncode == 0, again.stderr
    assert f"{last}: truncated, damaged" in again.stderr
    assert "goes on where it was interrupted, at epoch" in again.stderr
    assert place.read("report.json")["rows"] == whole
    assert [path.name.split("-")[0] for path in last.parent.iterdir()] == [f"{last.name}.damaged"]


@pytest.mark.slow
@pytest.mark.parametrize("number", range(KILLS))
def test_a_run_killed_at_any_moment_resumes_to_the_same_bits(number, place, whole):
    moment = MOMENTS[number % len(MOMENTS)]
    due = place.writes if moment == "checkpoint" else lambda: place.stage() == moment
    delay = random.Random(number).random() * (0.05 if moment == "checkpoint" else 4.0)  # s
    while not kill(place, due, delay, flights=moment == "data"):  # it ended before
        delay /= 2
    begun, reached = place.read("run.json"), place.checkpoints()
    assert begun["state"] == "unfinished"
    again = place.run()
    assert again.returncode == 0, again.stderr
    assert f"goes on with the run begun {begun['started']}" in again.stderr
    assert not reached or "goes on where it was interrupted, at epoch" in again.stderr
    assert "damaged" not in again.stderr
    assert place.read("report.json")["rows"] == whole
    assert place.read("run.json") == begun | {"state": "finished"}
    assert not list(place.cache.glob("stages/*.begun"))
