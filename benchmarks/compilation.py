"""How long does a process wait for its programs: from nothing, and with those that JAX's cache has?

An experiment in its smoke preset, which runs every program of the whole one on little data, in a process of its own and
with an empty cache; then once more with the cache of programs that the first one left, and nothing else of it. Counted
is the time in which JAX traces, lowers, compiles or reads a program from the cache, on any thread, and no moment twice.

Then `hybrid_jax.adapt` of a rigid body to a hundred windows, the whole process: import, first call, and a second call.
"""

import json
import os
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from benchmarks.timing import Findings, Ratio, run, run_together, table
from hybrid_jax.runtime import PROGRAMS

COLD, CACHED = 15.0, 2.0  # s, to reach
ADAPT_COLD, ADAPT_CACHED = 4.0, 1.5  # s, to reach: the first call; import and the first call


@dataclass(frozen=True)
class Preset:
    """The experiment and what of it is left out."""

    experiment: str
    options: tuple[str, ...] = ()


PRESETS = {
    "full": Preset("param_shift"),
    "smoke": Preset("param_shift", ("--models", "physics_only")),
}

# Runs in the process that is measured: notes when each stage of compilation ended and how long it took.
PROBE = """
import json, os, runpy, time
import jax
stages = []
jax.monitoring.register_event_duration_secs_listener(
    lambda name, seconds, **_: stages.append((name, time.monotonic(), seconds)) if "/compile/" in name else None
)
began = time.monotonic()
try:
    runpy.run_module(MODULE, run_name="__main__")
finally:
    with open(os.environ["HYBRID_JAX_PROBE"], "w") as file:
        json.dump({"seconds": time.monotonic() - began, "stages": stages}, file)
"""


# The same for a user's script: seconds of the import with all that it needs, of the first call and of a second one.
ADAPT = """
import json, sys, time
began = time.monotonic()
import hybrid_jax as hj
hj.adapt  # imports what it needs
imported = time.monotonic() - began
from pathlib import Path
import numpy as np
hj.runtime.configure(Path(sys.argv[1]))
draw = np.random.default_rng(0).normal
x0 = np.zeros((100, 13), "f4")
x0[:, :3], x0[:, 6] = draw(size=(100, 3)), 1
u = (600 + 50 * draw(size=(100, 10, 4))).astype("f4")
body = hj.rigid_body(hj.IRIS)
windows = hj.Trajectories(x0, u, np.asarray(hj.rollout_batch(body, x0, u, 0.01)), 0.01)
seconds = [imported]
for _ in range(2):
    began = time.monotonic()
    hj.adapt(body, windows)
    seconds.append(time.monotonic() - began)
print(json.dumps(seconds))
"""


def waited(stages: list[tuple[str, float, float]]) -> float:
    """Seconds covered by at least one stage, each given as name, end and length: stages nest, and threads overlap."""
    total, reached = 0.0, float("-inf")
    for start, end in sorted((end - seconds, end) for _, end, seconds in stages):
        total += max(0.0, end - max(start, reached))
        reached = max(reached, end)
    return total


def measure_run(preset: Preset, programs: Path, folder: Path) -> dict[str, Any]:
    """One run of the experiment, with nothing but these programs."""
    probe = folder / "probe.json"
    probed = PROBE.replace("MODULE", repr(f"experiments.{preset.experiment}"))
    folders = "--out", str(folder), "--cache", str(folder / "cache")
    command = ["-c", probed, "--preset", "smoke", *folders, *preset.options]
    run_together(preset.experiment, [command], os.environ | {PROGRAMS: str(programs), "HYBRID_JAX_PROBE": str(probe)})
    found = json.loads(probe.read_text())
    count = sum(name.endswith("backend_compile_duration") for name, *_ in found["stages"])
    return {"programs": count, "waited_seconds": waited(found["stages"]), "run_seconds": found["seconds"]}


def measure(preset: Preset) -> Findings:
    """From nothing, then with the programs alone."""
    rows = []
    with TemporaryDirectory() as folder:
        for case in ("cold", "cached"):
            out = Path(folder) / case
            out.mkdir()
            measured = measure_run(preset, Path(folder) / "programs", out)
            rows.append({"case": case, "experiment": preset.experiment, **measured})
    cold, cached = (row["waited_seconds"] for row in rows)
    with TemporaryDirectory() as folder:
        adapted = [json.loads(run_together("adapt", [["-c", ADAPT, folder]])[0].splitlines()[-1]) for _ in range(2)]
    names = "import_seconds", "first_seconds", "second_seconds"
    calls = [
        {"case": case, **dict(zip(names, seconds, strict=True))}
        for case, seconds in zip(("cold", "cached"), adapted, strict=True)
    ]
    first, again = calls
    ratios = [
        Ratio(f"seconds for all programs of {preset.experiment}, from nothing", cold, at_most=COLD),
        Ratio("the same with the cache", cached, at_most=CACHED),
        Ratio("seconds of the first adapt, from nothing", first["first_seconds"], at_most=ADAPT_COLD),
        Ratio(
            "seconds of import and the first adapt, with the cache",
            again["import_seconds"] + again["first_seconds"],
            at_most=ADAPT_CACHED,
        ),
    ]
    tables = [table(f"programs of {preset.experiment}", rows, COLUMNS), table("a script that adapts", calls, CALLS)]
    return Findings(rows + calls, tables, ratios)


COLUMNS = {
    "": lambda row: row["case"],
    "programs": lambda row: str(row["programs"]),
    "waited for them [s]": lambda row: f"{row['waited_seconds']:.1f}",
    "whole run [s]": lambda row: f"{row['run_seconds']:.1f}",
}
CALLS = {
    "": lambda row: row["case"],
    "import [s]": lambda row: f"{row['import_seconds']:.2f}",
    "first adapt [s]": lambda row: f"{row['first_seconds']:.2f}",
    "second [s]": lambda row: f"{row['second_seconds']:.2f}",
}


if __name__ == "__main__":
    run("compilation", __doc__, PRESETS, measure)
