"""Whole commands in their smallest preset, as a user starts them.

What continuous integration has already run it leaves in the folder that HYBRID_JAX_SMOKE names, in one folder for each
group of commands that share their cache: `out`, `cache`, and for each command its code.txt, out.txt and err.txt. Tests
look at that instead of running it all again.
"""

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
LEFT = os.environ.get("HYBRID_JAX_SMOKE")
Run = subprocess.CompletedProcess


def command(name: str, *options: str, folder: Path, out: Path | None = None) -> Run:
    """An experiment in its smallest preset, its cache and, by default, its results in a folder."""
    out = folder / "out" if out is None else out
    preset = [] if "--preset" in options else ["--preset", "smoke"]
    return python(f"experiments.{name}", *preset, "--out", str(out), "--cache", str(folder / "cache"), *options)


def python(module: str, *options: str) -> Run:
    """`python -m module options`."""
    run = [sys.executable, "-m", module, *options]
    return subprocess.run(run, capture_output=True, text=True, cwd=ROOT, env=os.environ | {"MPLBACKEND": "agg"})


def experiments(group: str, *names: str, folder: Path, options: Sequence[str] = ()) -> list[Run]:
    """Experiments one after the other with one cache: run now in the folder, or copied there as they were left."""
    if LEFT is None:
        return [command(name, *options, folder=folder) for name in names]
    shutil.copytree(Path(LEFT) / group, folder, dirs_exist_ok=True)
    return [told(folder, f"experiments.{name}") for name in names]


def benchmarks(folder: Path, *options: str) -> tuple[Run, dict[str, dict[str, Any]]]:
    """All benchmarks: what they said, and their reports by name; run now in the folder, or as they were left."""
    if LEFT is None:
        run = python("benchmarks", "--preset", "smoke", "--out", str(folder / "all.json"), *options)
        assert run.returncode == 0, run.stderr
    else:
        shutil.copytree(Path(LEFT) / "benchmarks", folder, dirs_exist_ok=True)
        run = told(folder, "benchmarks")
    reports = json.loads((folder / "all.json").read_text())["benchmarks"]
    return run, {report["benchmark"]: report for report in reports}


def told(folder: Path, module: str) -> Run:
    """What a command said that continuous integration ran in a folder."""
    code, out, err = ((folder / f"{module}.{part}.txt").read_text() for part in ("code", "out", "err"))
    return Run([module], int(code), out, err)


def refused(run: Run, name: str) -> str:
    """The one line on stderr with which a command ended that refuses its input, with exit code 2."""
    assert run.returncode == 2, run.stderr
    lines = run.stderr.strip().splitlines()
    assert len(lines) == 1, run.stderr
    assert lines[0].startswith(f"{name}: ")
    return lines[0]
