"""How many steps a second does our environment make, against C MuJoCo's own RK4 on the same flights?

Ours: MJX accelerations with the forces recomputed at each of the four stages, compiled by XLA, 64 flights side by side.
C MuJoCo: `mujoco.rollout`, RK4, on one thread, without drag and ground effect. One step is 0.01 s of one vehicle in
float64. Results must agree; compilation is timed apart. Set the cores with taskset.
smoke: one tiny batch. full: batches of 64, 256 and 1000 flights, about a minute and a half.
"""

# MuJoCo's compiled modules carry no type stubs.
# pyright: reportAttributeAccessIssue=false

from dataclasses import dataclass
from typing import Any

import jax
import mujoco
import mujoco.rollout
import numpy as np

from benchmarks.subjects import DT, make_flights
from benchmarks.timing import Call, Findings, Ratio, Times, agree, compiled, in_turns, run, table
from hybrid_jax.sim.domain import Quadrotor
from hybrid_jax.sim.forces import Force, drag, ground_effect, parameters_of
from hybrid_jax.sim.scene import build_model
from hybrid_jax.vehicle import IRIS

# Of the largest state. C MuJoCo's RK4 is of 2nd order in orientation, ours of 4th; the difference is its error.
AGREEMENT = 1e-3


@dataclass(frozen=True)
class Preset:
    """Batch sizes, steps of each flight, and turns."""

    batches: tuple[int, ...]
    steps: int
    turns: int


PRESETS = {
    "smoke": Preset((8,), steps=10, turns=2),
    "full": Preset((64, 256, 1000), steps=100, turns=10),
}


def compile_ours(forces: tuple[Force, ...], x0: np.ndarray, u: np.ndarray) -> tuple[Call, float]:
    """A call that flies them all, and the seconds of compiling it."""
    body = Quadrotor(parameters_of(IRIS), forces)
    return compiled(lambda body, *flights: body.rollouts(*flights, DT), body, x0, u, np.zeros(len(x0)))


def time_programs(
    programs: dict[str, tuple[Call, float]], batch: int, preset: Preset, alike: tuple[str, str], tolerance: float
) -> tuple[dict[str, Any], Times]:
    """A row for compiled programs that fly a batch, and their times. Two must be alike over the first 0.1 s."""
    calls = {name: call for name, (call, _) in programs.items()}
    flown = {name: jax.block_until_ready(call()) for name, call in calls.items()}
    ours, theirs = (np.asarray(flown[name])[:, :10] for name in alike)
    difference = agree(f"flights of {alike[0]} and {alike[1]}", ours, theirs, tolerance)
    times = in_turns(calls, preset.turns)
    return {
        "batch": batch,
        "steps": preset.steps,
        "difference": difference,
        "compile_seconds": {name: seconds for name, (_, seconds) in programs.items() if seconds},
        "steps_per_second": {name: batch * preset.steps / taken for name, taken in times.medians().items()},
    }, times


def measure_batch(batch: int, preset: Preset) -> dict[str, Any]:
    x0, u = make_flights(batch, preset.steps)
    model = build_model(IRIS)
    data = mujoco.MjData(model)
    initial = np.concatenate([np.zeros((batch, 1)), x0], axis=1)

    def in_c() -> np.ndarray:
        # Its state is time, qpos, qvel, which without time is ours.
        return np.asarray(mujoco.rollout.rollout(model, data, initial, u**2)[0])[..., 1:14]

    programs = {
        "ours": compile_ours((), x0, u),
        "ours_with_forces": compile_ours((drag, ground_effect), x0, u),
        "mujoco": (in_c, 0.0),
    }
    row, times = time_programs(programs, batch, preset, ("ours", "mujoco"), AGREEMENT)
    return row | {"mujoco_over_ours": times.ratio("mujoco", "ours")}


COLUMNS = {
    "flights": lambda row: str(row["batch"]),
    "ours": lambda row: f"{row['steps_per_second']['ours']:,.0f}",
    "with drag and ground effect": lambda row: f"{row['steps_per_second']['ours_with_forces']:,.0f}",
    "C MuJoCo": lambda row: f"{row['steps_per_second']['mujoco']:,.0f}",
    "ours / C": lambda row: f"{row['mujoco_over_ours']:.2f}",
    "compile [s]": lambda row: ", ".join(f"{seconds:.1f}" for seconds in row["compile_seconds"].values()),
    "differ by": lambda row: f"{row['difference']:.0e}",
}


def measure(preset: Preset) -> Findings:
    """Every batch size; the reach is asked of the last."""
    with jax.enable_x64(True):
        rows = [measure_batch(batch, preset) for batch in preset.batches]
    last = rows[-1]
    level = Ratio(f"steps/s, {last['batch']} flights: ours / C MuJoCo", last["mujoco_over_ours"], at_least=1.0)
    return Findings(rows, [table(f"steps of {DT} s per second", rows, COLUMNS)], [level])


if __name__ == "__main__":
    run("environment", __doc__, PRESETS, measure)
