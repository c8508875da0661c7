"""How much longer does a fit take if only the angle of a pendulum is measured, and not its rate?

The pendulum's length and damping are fitted to records with noise and random torques, of 20 ms a sample. The initial
state of each record is unknown in both fits.
"""

import time
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import hybrid_jax as hj
from benchmarks.timing import Findings, Ratio, agree, in_turns, run, table

DT, NOISE, LENGTH, DAMPING = 0.02, 0.01, 0.8, 0.3  # s, rad and rad/s, m, 1/s
OUTPUTS = {"angle": lambda x, u: x[0], "rate": lambda x, u: x[1]}
MEASURED = {"both": ("angle", "rate"), "angle": ("angle",)}


@dataclass(frozen=True)
class Preset:
    """Cases, each a number of records and the seconds of each; and turns."""

    cases: tuple[tuple[int, float], ...]
    turns: int


PRESETS = {"full": Preset(((50, 2.0), (1, 60.0), (1, 600.0)), turns=5), "smoke": Preset(((20, 2.0),), turns=1)}


class Pendulum(hj.AbstractVectorField):
    log_length: jax.Array
    damping: jax.Array

    def __call__(self, x, u):
        return jnp.stack([x[1], u[0] - 9.81 / jnp.exp(self.log_length) * jnp.sin(x[0]) - self.damping * x[1]])


def pendulum(length: float, damping: float) -> Pendulum:
    return Pendulum(jnp.log(length), jnp.array(damping))


def records(count: int, seconds: float) -> list[hj.Record]:
    rng, t = np.random.default_rng(0), np.arange(0, seconds, DT)
    x0, u = 0.5 * rng.standard_normal((count, 2)), rng.standard_normal((count, len(t), 1))
    moved = np.asarray(hj.rollout_batch(pendulum(LENGTH, DAMPING), x0, u, DT))
    x = np.concatenate([x0[:, None], moved], axis=1)[:, :-1] + NOISE * rng.standard_normal((count, len(t), 2))
    return [hj.Record.of(str(i), u=(t, u[i]), angle=(t, x[i, :, :1]), rate=(t, x[i, :, 1:])) for i in range(count)]


def fitted(flown: list[hj.Record], measured: tuple[str, ...]) -> Any:
    """The fit, which must find the length within a percent."""
    outputs = {name: OUTPUTS[name] for name in measured}
    model = hj.StateSpaceModel(pendulum(1.0, 0.1), ("u",), outputs, start=(0.0, 0.0), spread=(1.0, 1.0))
    found: Any = hj.fit_records(model, flown, dt=DT)
    agree("lengths", jnp.exp(found.model.field.log_length), LENGTH, 0.01)
    return found


def timed(count: int, seconds: float, turns: int) -> dict[str, Any]:
    flown = records(count, seconds)
    calls = {name: partial(fitted, flown, measured) for name, measured in MEASURED.items()}
    for call in calls.values():
        call()
    times = in_turns(calls, turns, clock=time.process_time)
    found = {name: times.median(name) for name in MEASURED}
    return {"records": count, "seconds": seconds, "processor_seconds": found, "ratio": times.ratio("angle", "both")}


COLUMNS = {
    "records": lambda row: str(row["records"]),
    "seconds": lambda row: f"{row['seconds']:g}",
    "both measured [s]": lambda row: f"{row['processor_seconds']['both']:.2f}",
    "angle measured [s]": lambda row: f"{row['processor_seconds']['angle']:.2f}",
    "ratio": lambda row: f"{row['ratio']:.2f}",
}


def measure(preset: Preset) -> Findings:
    rows = [timed(*case, preset.turns) for case in preset.cases]
    ratios = [
        Ratio(f"{row['records']} × {row['seconds']:g} s: hidden rate / measured", row["ratio"], at_most=2)
        for row in rows
    ]
    return Findings(rows, [table("processor time of a fit", rows, COLUMNS)], ratios)


if __name__ == "__main__":
    run("records", __doc__, PRESETS, measure)
