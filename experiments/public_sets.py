"""What `hybrid-jax` alone makes of public logs: python -m experiments.public_sets FLIGHTS LOGS OUT [SET …]"""

import json
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

# Of each set: folders that are made of files of FLIGHTS and LOGS, then what is typed.
SETS = """
payload
before = crazyflie_payload/bare/*.gz
after = crazyflie_payload/payload/flight_[2-6]*
others = crazyflie_payload/payload/flight_[01]*
$ fit before -o m.npz --vehicle {flights}/crazyflie_payload/vehicle.toml --learn {learn}
$ adapt m.npz after -o a.npz
$ check a.npz others
nanodrone
before = nanodrone/train/*
others = nanodrone/valid/*
$ fit before -o m.npz --vehicle {flights}/nanodrone/vehicle.toml --learn {learn}
$ check m.npz others
sysid_tools
before = sysid_tools/log*
$ inspect before --write-vehicle v.toml --mass 0.027 --arm 0.0396
$ fit before -o m.npz --vehicle v.toml --learn curve,time_constant,Ix,Iy
quadrotor_model
before = px4/quadrotor_model.csv.gz
$ inspect before --columns {maps}/quadrotor_model.toml --write-vehicle v.toml --mass 1.5 --arm 0.255
$ fit before -o m.npz --vehicle v.toml --columns {maps}/quadrotor_model.toml --learn curve,time_constant,Ix,Iy
nanobench
before = nanobench/B[23]*_rep1.csv.gz nanobench/B7_oval_fast*.gz
after = nanobench/B2_circle_fast_rep3.csv.gz
others = nanobench/B5*.gz nanobench/B7_oval_slow*.gz nanobench/B8_star_fast*.gz
$ inspect before --columns {maps}/nanobench.toml --write-vehicle v.toml --mass 0.027 --arm 0.046
$ fit before -o m.npz --vehicle v.toml --columns {maps}/nanobench.toml --learn curve,time_constant
$ adapt m.npz after -o a.npz --columns {maps}/nanobench.toml
$ check m.npz others --columns {maps}/nanobench.toml
$ check a.npz others --columns {maps}/nanobench.toml
crazypad
before = crazypad/motor_data/normal_flight/E8_log0[023].gz
mm43 = crazypad/motor_data/cut_propeller_M3_2mm_2mm_43mm/E8_log03.gz
mm41 = crazypad/motor_data/cut_propeller_M3_3mm_3mm_41mm/E8*
$ inspect before --write-vehicle v.toml --mass 0.036 --arm 0.046
$ fit before -o m.npz --vehicle v.toml --learn k_rotors
$ adapt m.npz mm43 -o a.npz
$ adapt m.npz mm41 -o b.npz
"""
LEARN = "Ix,Iy,Iz,k_rotors,rate_damping,drag,aerodynamic_moment"


def main() -> None:
    """Run the sets, or those that are named, and print a line of Markdown for each command."""
    if len(sys.argv) < 4:
        sys.exit((__doc__ or "").partition(": ")[2])
    flights, logs, out = (Path(each).resolve() for each in sys.argv[1:4])
    values = {"flights": flights, "maps": Path(__file__).parent / "identification", "learn": LEARN}
    print("| set | hybrid-jax … | seconds | answer | RMSE after 0.1 s, of frozen rates |\n|---|---|---|---|---|")
    work = out
    for line in SETS.strip().splitlines():
        folder, _, globs = line.partition(" = ")
        if not globs and not line.startswith("$"):
            work = out / line
        elif work.name not in (sys.argv[4:] or work.name):
            continue
        elif globs:
            (work / folder).mkdir(parents=True, exist_ok=True)
            for file in (file for each in globs.split() for root in (flights, logs) for file in root.glob(each)):
                link = work / folder / f"{file.parent.name}_{file.name}"
                link.unlink(missing_ok=True)
                link.symlink_to(file)
        else:
            began, typed = time.perf_counter(), line.removeprefix("$ ").format(**values).split()
            run = [sys.executable, "-m", "hybrid_jax", *typed]
            done = subprocess.run(run, cwd=work, capture_output=True, text=True)
            found: dict[str, Any] = {"answer": (done.stderr.strip().splitlines() or [""])[-1]}
            if done.returncode in (0, 4):
                reports = sorted(work.glob("runs/*/report.json"), key=lambda path: path.stat().st_mtime)
                found = json.loads(reports[-1].read_text())
            rmse = [found.get("rmse", {}).get(name, {}) for name in ("model", "thrust, rates frozen")]
            told = "; ".join(" ".join(f"{each:.3g}" for each in one["mean"]) for one in rmse if "mean" in one)
            seconds = time.perf_counter() - began
            print(f"| {work.name} | `{line[2:]}` | {seconds:.0f} | {found['answer']} | {told} |", flush=True)


if __name__ == "__main__":
    main()
