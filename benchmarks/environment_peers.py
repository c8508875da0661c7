"""How many steps a second does our environment make, against rigid-body JAX written by hand and against crazyflow?

By hand: the same vehicle without drag and ground effect, RK4 in a `lax.scan` under `vmap`; its flights must agree with
ours. crazyflow simulates a Crazyflie with drag and rotor dynamics, so only speeds can be compared. One step is 0.01 s
of one vehicle in float64, all on one core; compilation is timed apart. crazyflow 0.4.0 refuses jax 0.10.2, so it is not
in the extra `peers`. smoke: one tiny batch. full: batches of 64 and 1000 flights.
"""

# crazyflow is rarely installed.
# pyright: reportMissingImports=false

import os

os.environ["SCIPY_ARRAY_API"] = "1"  # crazyflow asks for it, before anything imports SciPy

import contextlib
from functools import partial
from tempfile import TemporaryDirectory
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from rich.markup import escape
from rich.table import Table

from benchmarks import environment, plain
from benchmarks.peers import installed, keep_to_one_core, skipped
from benchmarks.subjects import DT, make_flights
from benchmarks.timing import Call, Findings, Ratio, compiled, run
from hybrid_jax.sim.forces import drag, ground_effect
from hybrid_jax.vehicle import IRIS

OURS, OURS_WITH_FORCES, BY_HAND, CRAZYFLOW = "ours", "ours, with forces", "by hand", "crazyflow"
REMEDY = "pip install crazyflow==0.4.0, in an environment whose jax is not 0.10.2"
AGREEMENT = 1e-8  # ours makes q a unit again after each step, by hand it drifts by the error of RK4
COMPARED = {
    BY_HAND: (OURS, "ours / by hand"),
    CRAZYFLOW: (OURS_WITH_FORCES, "ours with forces / crazyflow, another vehicle"),
}

PRESETS = {
    "smoke": environment.Preset((8,), steps=10, turns=2),
    "full": environment.Preset((64, 1000), steps=100, turns=10),
}


def compile_crazyflow(flights: int, steps: int) -> tuple[Call, float]:
    """crazyflow's default vehicle, hovering at 1 m but for 5 % of its rotor speeds."""
    from crazyflow.control import Control
    from crazyflow.control.transform import motor_force2rotor_vel
    from crazyflow.sim import Sim
    from crazyflow.sim.functional import rotor_vel_control
    from crazyflow.sim.integration import Integrator

    with TemporaryDirectory() as folder, contextlib.chdir(folder):  # MuJoCo leaves its log where it is
        sim = Sim(flights, control=Control.rotor_vel, integrator=Integrator.rk4, freq=round(1 / DT))
    advance, data = sim.build_step_fn(), sim.data
    weight = -data.params.mass * data.params.gravity_vec[..., 2]
    hover = motor_force2rotor_vel(weight.reshape(-1)[:1] / 4, data.params.rpm2thrust.reshape(-1, 3)[:1])  # rpm
    commands = hover * np.random.default_rng(0).uniform(0.95, 1.05, size=(steps, flights, 1, 4))
    states = data.states.replace(pos=data.states.pos.at[..., 2].set(1.0), rotor_vel=jnp.full((flights, 1, 4), hover))

    def step(data, held):
        data = advance(rotor_vel_control(data, held), 1)
        return data, (data.states.pos, data.states.quat, data.states.vel, data.states.ang_vel)

    return compiled(lambda *flight: jax.lax.scan(step, *flight)[1], data.replace(states=states), commands)


def measure_batch(batch: int, preset: environment.Preset) -> dict[str, Any]:
    x0, u = make_flights(batch, preset.steps)
    programs: dict[str, tuple[Call, float]] = {
        OURS: environment.compile_ours((), x0, u),
        BY_HAND: compiled(jax.vmap(partial(plain.rk4, partial(plain.rigid_body, IRIS))), x0, u),
    }
    if installed("crazyflow"):
        programs[OURS_WITH_FORCES] = environment.compile_ours((drag, ground_effect), x0, u)
        programs[CRAZYFLOW] = compile_crazyflow(batch, preset.steps)
    row, times = environment.time_programs(programs, batch, preset, (OURS, BY_HAND), AGREEMENT)
    ratios = {rival: times.ratio(rival, ours) for rival, (ours, _) in COMPARED.items() if rival in programs}
    return row | {"rival_over_ours": ratios}


def table_of(rows: list[dict[str, Any]], absent: list[dict[str, Any]]) -> Table:
    table = Table("flights", "", "steps/s", r"compile \[s]", "differs by", title=f"steps of {DT} s per second")
    for row in rows:
        compared = {BY_HAND: f"{row['difference']:.0e}", CRAZYFLOW: "another vehicle: not compared"}
        for name, speed in row["steps_per_second"].items():
            compiling = f"{row['compile_seconds'][name]:.1f}"
            table.add_row(str(row["batch"]), name, f"{speed:,.0f}", compiling, compared.get(name, ""))
    for row in absent:
        table.add_row("", row["rival"], "", "", escape(row["skipped"]))
    return table


def measure(preset: environment.Preset) -> Findings:
    """Every batch size; the ratios are those of the last; no reach is asked for."""
    with jax.enable_x64(True):
        rows = [measure_batch(batch, preset) for batch in preset.batches]
    absent = [] if installed("crazyflow") else [skipped(CRAZYFLOW, REMEDY)]
    task = f"steps/s on one core, {rows[-1]['batch']} flights"
    ratios = [Ratio(f"{task}: {COMPARED[rival][1]}", value) for rival, value in rows[-1]["rival_over_ours"].items()]
    return Findings([*rows, *absent], [table_of(rows, absent)], ratios)


if __name__ == "__main__":
    keep_to_one_core()
    run("environment_peers", __doc__, PRESETS, measure)
