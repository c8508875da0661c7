"""Whole commands in their smallest preset, as a user starts them.

.ci/run runs most of them first. It names their folder in HYBRID_JAX_SMOKE, with a subfolder for each group of commands
that share a cache: `out`, `cache`, and for each command code.txt, out.txt and err.txt. Tests use these if they exist.
"""

import contextlib
import io
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from typing import Any
from unittest import mock

ROOT = Path(__file__).parents[1]
LEFT = os.environ.get("HYBRID_JAX_SMOKE")
Run = subprocess.CompletedProcess


def command(name: str, *options: str, folder: Path, out: Path | None = None) -> Run:
    """Run an experiment in its smallest preset, with its cache and, by default, its results in a folder."""
    return python(f"experiments.{name}", *smallest(*options, folder=folder, out=out))


def smallest(*options: str, folder: Path, out: Path | None = None) -> list[str]:
    """The options of `command`."""
    out = folder / "out" if out is None else out
    preset = [] if "--preset" in options else ["--preset", "smoke"]
    return [*preset, "--out", str(out), "--cache", str(folder / "cache"), *options]


def script(*arguments: object, **options: Any) -> str:
    """What Python prints with these arguments, once it has ended well."""
    run = [sys.executable, *map(str, arguments)]
    done = subprocess.run(run, capture_output=True, text=True, **{"cwd": ROOT} | options)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def python(module: str, *options: str) -> Run:
    """`python -m module options`."""
    run = [sys.executable, "-m", module, *options]
    return subprocess.run(run, capture_output=True, text=True, cwd=ROOT, env=os.environ | {"MPLBACKEND": "agg"})


def experiments(group: str, *names: str, folder: Path, options: Sequence[str] = ()) -> list[Run]:
    """Experiments one after the other with one cache: run now in the folder, or copied there from .ci/run."""
    if LEFT is None:
        return [command(name, *options, folder=folder) for name in names]
    shutil.copytree(Path(LEFT) / group, folder, dirs_exist_ok=True)
    return [_finished(folder, f"experiments.{name}") for name in names]


def benchmark(name: str, folder: Path) -> tuple[Run, dict[str, Any]]:
    """A benchmark's output and its report: run now in the folder, or copied there from .ci/run."""
    if LEFT is None:
        run = python(f"benchmarks.{name}", "--preset", "smoke", "--output", str(folder / f"{name}.json"))
        assert run.returncode == 0, run.stderr
    else:
        shutil.copytree(Path(LEFT) / "benchmarks", folder, dirs_exist_ok=True)
        run = _finished(folder, f"benchmarks.{name}")
    return run, json.loads((folder / f"{name}.json").read_text())


def _finished(folder: Path, module: str) -> Run:
    """The exit code and output of a command that .ci/run ran in a folder."""
    code, out, err = ((folder / f"{module}.{part}.txt").read_text() for part in ("code", "out", "err"))
    return Run([module], int(code), out, err)


def unbegun(name: str, *arguments: str) -> Run:
    """Run an experiment in this process whose options end it before it sets anything up."""
    module, out, err = f"experiments.{name}", io.StringIO(), io.StringIO()
    begun = mock.patch("experiments.runner.command.configure", side_effect=AssertionError("work has begun"))
    said = mock.patch.object(sys, "argv", [module, *arguments])
    with begun, said, contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            package = (ROOT / "experiments" / name).is_dir()
            import_module(f"{module}.__main__" if package else module).main()
        except SystemExit as stop:
            return Run([module, *arguments], int(stop.code or 0), out.getvalue(), err.getvalue())
    raise AssertionError("the command did not end by itself")


def refused(run: Run, name: str) -> str:
    """The one line on stderr of a command that refused its input with exit code 2."""
    assert run.returncode == 2, run.stderr
    lines = run.stderr.strip().splitlines()
    assert len(lines) == 1, run.stderr
    assert lines[0].startswith(f"{name}: ")
    return lines[0]
