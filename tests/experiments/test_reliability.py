"""Runs that cannot be lost: real commands, killed, starved and given other inputs. See docs/reliability.md.

HYBRID_JAX_KILLS sets how many times a run is killed; 20 by default would take minutes.
"""

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
KILLS = int(os.environ.get("HYBRID_JAX_KILLS", "2"))
EPOCHS = "600"
TRIES = 5
SMALL = [
    "--preset", "smoke", "--models", "hybrid", "--saving", "1", "--max-epochs", EPOCHS,
    "--patience.hybrid-pretraining.minimum", EPOCHS, "--patience.hybrid-minimum", *[EPOCHS] * 5,
]  # fmt: skip
STAGES = ("data", "pre-training", "adaptation", "report")
MOMENTS = ("a checkpoint being written", "pre-training", "adaptation", "data", "report")


class Place:
    """A cache and a folder of results; every test begins with flights and compiled programs in it, and no more."""

    def __init__(self, folder):
        self.cache, self.out = folder / "cache", folder / "out"
        self.results = self.out / "param_shift"

    def clear(self, flights=False):
        shutil.rmtree(self.cache / "sweeps", ignore_errors=True)
        shutil.rmtree(self.out, ignore_errors=True)
        for path in self.cache.glob("flights-*.npz") if flights else ():
            path.unlink()

    def command(self, *options):
        run = [sys.executable, "-m", "experiments.param_shift", *SMALL, *options]
        return [*run, "--out", str(self.out), "--cache", str(self.cache)]

    def run(self, *options, **how):
        how = {"env": os.environ | {"MPLBACKEND": "agg"}} | how
        return subprocess.run(self.command(*options), capture_output=True, text=True, cwd=ROOT, **how)

    def rows(self):
        return json.loads((self.results / "report.json").read_text())["rows"]

    def record(self):
        """What is known of the run; None while nothing is, as when what was there is being moved aside."""
        try:
            return json.loads((self.results / "run.json").read_text())
        except FileNotFoundError:
            return None

    def stage(self):
        """The stage in which a run is, by what is there."""
        if not (self.results / "run.json").exists():
            return "start"
        if len(list(self.cache.glob("flights-*.npz"))) < 2:
            return "data"
        sweeps = [path.name for path in self.cache.glob("sweeps/*.npz")]
        if len(sweeps) == 3:
            return "report"
        return "adaptation" if sweeps else "pre-training"

    def writes(self):
        """Whether a checkpoint is being written."""
        return any(self.cache.glob("sweeps/*.begun/.*.part"))

    def checkpoints(self):
        try:
            return sorted(self.cache.glob("sweeps/*.begun/*.npz"))
        except FileNotFoundError:  # the sweep has ended while we looked
            return []


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    return Place(tmp_path_factory.mktemp("reliability"))


@pytest.fixture(scope="module")
def whole(place):
    """The rows of a run that nothing interrupted, and the seconds that it spent in each stage, compiling among them."""
    spent = dict.fromkeys(STAGES, 0.0)
    with subprocess.Popen(place.command(), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, cwd=ROOT) as process:
        last = time.perf_counter()
        while process.poll() is None:
            time.sleep(0.002)
            now, stage = time.perf_counter(), place.stage()
            if stage in spent:
                spent[stage] += now - last
            last = now
    assert process.returncode == 0
    assert place.record()["state"] == "finished"
    return place.rows(), spent


@pytest.fixture(autouse=True)
def _empty(whole, place):
    place.clear()


def killed(place, moment, delay):
    """Start the command and kill -9 it this long after the moment has come; whether it was killed before its end."""
    with subprocess.Popen(place.command(), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, cwd=ROOT) as process:
        while process.poll() is None and not (place.writes() if moment not in STAGES else place.stage() == moment):
            time.sleep(0.0005)
        time.sleep(delay)
        process.kill()
    return process.returncode == -9


@pytest.mark.parametrize("number", range(KILLS))
def test_a_killed_run_goes_on_by_itself_to_the_same_bits(number, place, whole):
    rows, spent = whole
    moment = MOMENTS[number % len(MOMENTS)]
    # A checkpoint is written within some 50 ms.
    delay = random.Random(number).random() * spent.get(moment, 0.05)
    place.clear(flights=moment == "data")
    while not killed(place, moment, delay):  # the stage was shorter than when it was timed
        place.clear(flights=moment == "data")
        delay /= 2
    begun = place.record()
    reached = place.checkpoints()
    assert begun["state"] == "unfinished"
    again = place.run()
    assert again.returncode == 0, again.stderr
    assert f"goes on with the run begun {begun['started']}" in again.stderr
    assert not reached or "goes on where it was interrupted, at epoch" in again.stderr
    assert "damaged" not in again.stderr
    assert place.rows() == rows
    assert place.record() == begun | {"state": "finished"}
    assert not list(place.cache.glob("sweeps/*.begun"))


@pytest.fixture(scope="module")
def begun_once(place, whole, tmp_path_factory):
    """A copy of what a run has left that was killed with two checkpoints of a sweep saved."""
    interrupted(place)
    kept = tmp_path_factory.mktemp("begun")
    for name in ("cache", "out"):
        shutil.copytree(getattr(place, name), kept / name, ignore=shutil.ignore_patterns("programs"))
    return kept


@pytest.fixture
def begun(place, begun_once, _empty):
    """The place as that run left it."""
    for name in ("cache", "out"):
        shutil.copytree(begun_once / name, getattr(place, name), dirs_exist_ok=True)


def interrupted(place, checkpoints=2):
    """Kill a run as soon as it has saved so many checkpoints of a sweep; another, if a busy machine let it run on."""
    for _ in range(TRIES):
        place.clear()
        with subprocess.Popen(
            place.command(), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, cwd=ROOT
        ) as process:
            while len(place.checkpoints()) < checkpoints and process.poll() is None:
                time.sleep(0.0005)
            process.kill()
        if process.returncode == -9 and len(place.checkpoints()) >= checkpoints:
            return
    pytest.fail(f"none of {TRIES} runs could be killed in time")


@pytest.mark.usefixtures("begun")
def test_a_truncated_checkpoint_is_set_aside_and_the_one_before_it_used(place, whole):
    last = place.checkpoints()[-1]
    os.truncate(last, last.stat().st_size // 2)
    again = place.run()
    assert again.returncode == 0, again.stderr
    assert f"{last}: truncated, damaged" in again.stderr
    assert "goes on where it was interrupted, at epoch" in again.stderr
    assert place.rows() == whole[0]
    assert [path.name.split("-")[0] for path in last.parent.iterdir()] == [f"{last.name}.damaged"]


@pytest.mark.usefixtures("begun")
def test_a_full_disk_ends_in_one_line_and_what_was_saved_is_used(place, whole):
    """No file may grow beyond 3 kB: the write of the next checkpoint fails as on a full disk."""
    kept = {path: path.read_bytes() for path in place.checkpoints()}
    limited = ["sh", "-c", 'ulimit -f 6; exec "$@"', "sh", *place.command()]  # blocks of 512 bytes
    full = subprocess.run(limited, capture_output=True, text=True, cwd=ROOT)
    assert full.returncode == 2, full.stderr
    (line,) = [line for line in full.stderr.splitlines() if "cannot be saved" in line]
    assert "what was saved before is intact" in line
    assert "Traceback" not in full.stderr
    assert all(path.read_bytes() == content for path, content in kept.items())
    again = place.run()
    assert "goes on where it was interrupted, at epoch" in again.stderr
    assert place.rows() == whole[0]


@pytest.mark.usefixtures("begun")
def test_another_run_is_refused_until_told_to_start_anew(place, whole):
    begun = place.record()
    other = place.run("--regulariser-weight", "0.01")
    assert other.returncode == 2
    assert f"holds an unfinished run, begun {begun['started']}, that differs:" in other.stderr
    assert "  config.regulariser_weight: 0.001 → 0.01\n" in other.stderr
    assert "--fresh" in other.stderr
    assert place.record() == begun
    # That such a run ends well is what all others show.
    started = place.command("--regulariser-weight", "0.01", "--fresh")
    with subprocess.Popen(started, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, cwd=ROOT) as process:
        while place.record() in (None, begun):
            time.sleep(0.01)
            assert process.poll() is None
        process.kill()
    assert place.record()["config"]["regulariser_weight"] == 0.01
    (aside,) = place.out.glob("param_shift.before-*")
    assert json.loads((aside / "run.json").read_text()) == begun


@pytest.mark.usefixtures("begun")
def test_a_sweep_begun_by_another_version_is_refused(place, whole, tmp_path):
    """A package of another version number stands before the installed one, as after an upgrade."""
    shutil.rmtree(place.out)  # of the run nothing but the sweep is left
    about = tmp_path / "jax-99.0.dist-info" / "METADATA"
    about.parent.mkdir()
    about.write_text("Metadata-Version: 2.1\nName: jax\nVersion: 99.0\n")
    paths = os.pathsep.join([str(tmp_path), os.environ.get("PYTHONPATH", "")])
    upgraded = os.environ | {"PYTHONPATH": paths, "MPLBACKEND": "agg"}
    refused = place.run(env=upgraded)
    assert refused.returncode == 2
    assert "was begun with versions" in refused.stderr
    assert "  versions.jax: " in refused.stderr
    assert "→ 99.0\n" in refused.stderr
    (begun,) = place.cache.glob("sweeps/*.begun")
    assert place.run("--fresh", env=upgraded).returncode == 0
    assert len(list(begun.parent.glob(f"{begun.name}.before-*/*"))) >= 1
