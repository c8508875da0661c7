"""Run `hybrid-jax` on public logs: python -m experiments.public_sets FLIGHTS LOGS OUT [SET …]"""

import json
import resource
import subprocess
import sys
import time
import tomllib
from pathlib import Path
from typing import Any

import numpy as np

from hybrid_jax.identification.learning import rmse

LEARN = "Ix,Iy,Iz,k_rotors,rate_damping,drag,aerodynamic_moment"
HEADER = "| set | hybrid-jax … | s, wall s | answer | RMSE after 0.1, 0.5 s; of frozen rates |\n|---|---|---|---|---|"


def main() -> None:
    """Run the sets of public_sets.toml, or the given ones, and print a line of Markdown for each command."""
    asked = {"-h", "--help"} & {*sys.argv[1:]}
    if asked or len(sys.argv) < 4:
        sys.exit(print(__doc__) if asked else f"usage: {(__doc__ or '').partition(': ')[2]}")
    flights, logs, out = (Path(each).resolve() for each in sys.argv[1:4])
    values = {"flights": flights, "maps": Path(__file__).parent / "identification", "learn": LEARN}
    sets = tomllib.loads(Path(__file__).with_suffix(".toml").read_text("utf-8"))
    print(HEADER)
    for name in sys.argv[4:] or sets:
        for folder in sets[name].keys() - {"typed"}:
            (out / name / folder).mkdir(parents=True, exist_ok=True)
            for file in (file for each in sets[name][folder] for root in (flights, logs) for file in root.glob(each)):
                link = out / name / folder / f"{file.parent.name}_{file.name}"
                link.unlink(missing_ok=True)
                link.symlink_to(file)
        for line in sets[name]["typed"]:
            began, clock, given = processor(), time.perf_counter(), line.format(**values).split()
            found = ran(out / name, given)
            models = [found.get("rmse", {}).get(model, {}) for model in ("model", "thrust, rates frozen")]
            told = "; ".join(", ".join(map(shown, (one["short"], one["long"]))) for one in models if "long" in one)
            seconds = f"{processor() - began:.0f}, {time.perf_counter() - clock:.0f}"
            print(f"| {name} | `{line}` | {seconds} | {found['answer']} | {told} |", flush=True)


def ran(folder: Path, given: list[str]) -> dict[str, Any]:
    run = [sys.executable, "-m", "hybrid_jax", *given]
    done = subprocess.run(run, cwd=folder, capture_output=True, text=True)
    if done.returncode not in (0, 4):
        return {"answer": (done.stderr.strip().splitlines() or [""])[-1]}
    return json.loads((folder / "runs" / given[0] / "report.json").read_text("utf-8"))


def shown(errors: list[list[float]]) -> str:
    """Over flights."""
    return " ".join(f"{each:.3g}" for each in rmse(np.array(errors)))


def processor() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


if __name__ == "__main__":
    main()
