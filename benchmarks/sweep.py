"""Which width of a chunk of lanes is best on this backend?

Lanes train as in `hybrid_jax.sweep`. Measured is an epoch of one lane, copies included, for chunks of several widths,
for one lane up to all, on one device and on all; `hybrid_jax.sweep.lanes.WIDTH` should be the best width for all lanes
on all devices. Results must agree. On a CPU a device is not one core: its larger operations use all cores; set one core
with taskset.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
from rich.table import Table

from benchmarks.subjects import SETTINGS, Model, make_windows, training_runs
from benchmarks.timing import Findings, Ratio, Times, agree, in_turns, run, stopwatch
from hybrid_jax.sweep.lanes import WIDTH, LaneMap
from hybrid_jax.training import fitting
from hybrid_jax.training.fitting import FitState

# Losses after some steps of Adam, which divides by small numbers, in float32 with sums in another order.
AGREEMENT = 1e-3
FLAT, SHARED = 1.15, 0.9  # to reach: the cost of a lane among many over that of a few; the gain by each device
CLOSE = 1.05  # the default width's cost over the best width's


@dataclass(frozen=True)
class Preset:
    """What is swept over, what a lane does in an epoch, and turns."""

    model: Model
    one_device: bool  # whether to measure on one device too, not only on all
    widths: tuple[int, ...]
    lanes: tuple[int, ...]  # how many train, in rising order; every program is made for the last
    n_train: int
    validation: int
    turns: int


PRESETS = {
    "full": Preset("hybrid", True, (1, 2, 5, 10), (1, 2, 5, 10, 50), n_train=500, validation=1000, turns=10),
    "smoke": Preset("no_physics", False, (1, 2), (1, 2), n_train=100, validation=10, turns=2),
}
Program = Callable[[int], FitState]
Place = tuple[int, int]  # devices, width


def make_program(preset: Preset, devices: int, width: int) -> Program:
    """One epoch of the first so many lanes, as `hybrid_jax.sweep` runs a block of epochs."""

    def epoch(lane, train, validation):
        state, plan = lane
        return fitting.run(state, plan, train, validation, SETTINGS, state.epoch + 1)[0]

    mapped = LaneMap(epoch, width, jax.local_devices()[:devices])
    lanes = preset.lanes[-1]
    start = training_runs(preset.model, lanes, preset.n_train)
    shared = make_windows(preset.n_train, 10), make_windows(preset.validation, 10)
    return lambda active: mapped(start, shared, [1.0] * lanes, range(active))


def losses(states: FitState):
    """What programs must agree on."""
    return states.train_loss, states.best_mse


def make_programs(preset: Preset) -> tuple[dict[Place, Program], dict[Place, float]]:
    """A program for each place, and the seconds of each one's first run, most of them compilation."""
    every, total = jax.local_device_count(), preset.lanes[-1]
    devices = sorted({1, every}) if preset.one_device else [every]
    widths = sorted({*preset.widths, default_width(preset)})
    programs, seconds, first = {}, {}, None
    for place in ((number, width) for number in devices for width in widths):
        program = programs[place] = make_program(preset, *place)
        states, seconds[place] = stopwatch(lambda program=program: program(total))
        first = states if first is None else first
        agree(f"losses on {place[0]} devices in chunks of {place[1]}", losses(states), losses(first), AGREEMENT)
    return programs, seconds


def default_width(preset: Preset) -> int:
    """The width that a sweep takes unasked: a backend without a measured one takes all lanes at once."""
    return WIDTH.get(jax.default_backend(), preset.lanes[-1])


def table_of(rows: list[dict[str, Any]]) -> Table:
    """A line for each width, a column for each number of lanes."""
    counts = sorted({row["lanes"] for row in rows})
    heads = ("devices", "width", *(f"{count} lane{'s'[: count > 1]}" for count in counts), "first run [s]")
    made = Table(*heads, title="ms per lane and epoch")
    lines: dict[Place, list[dict[str, Any]]] = {}
    for row in rows:
        lines.setdefault((row["devices"], row["width"]), []).append(row)
    for (devices, width), line in lines.items():
        costs = (f"{1e3 * row['seconds_per_lane_epoch']:.1f}" for row in line)
        made.add_row(str(devices), str(width), *costs, f"{line[0]['first_run_seconds']:.1f}")
    return made


def ratios_of(preset: Preset, times: Times, width: int, best: int) -> list[Ratio]:
    """The default width against the best; flatness over lanes on fewest devices; the gain by all devices."""
    total, few, every = preset.lanes[-1], min(place[0] for place in times.seconds), jax.local_device_count()
    least = next((lanes for lanes in preset.lanes if lanes >= width * few), total)
    flat = times.ratio((few, width, total), (few, width, least)) * least / total
    chosen = times.ratio((every, width, total), (every, best, total))
    ratios = [
        Ratio(f"{total} lanes in chunks of {width} / of {best}", chosen, at_most=CLOSE),
        Ratio(f"cost per lane on {few} device{'s'[: few > 1]}, {total} lanes / {least}", flat, at_most=FLAT),
    ]
    if few < every:
        gain = times.ratio((few, width, total), (every, width, total))
        ratios.append(Ratio(f"{total} lanes, {few} device / {every} devices", gain, at_least=SHARED * every))
    return ratios


def measure(preset: Preset) -> Findings:
    """All widths."""
    programs, compiling = make_programs(preset)
    calls = {(*place, lanes): partial(program, lanes) for place, program in programs.items() for lanes in preset.lanes}
    times = in_turns(calls, preset.turns)
    rows = [
        {
            "devices": devices,
            "width": width,
            "lanes": lanes,
            "seconds_per_lane_epoch": seconds / lanes,
            "first_run_seconds": compiling[devices, width],
        }
        for (devices, width, lanes), seconds in times.medians().items()
    ]
    last = [row for row in rows if (row["devices"], row["lanes"]) == (rows[-1]["devices"], rows[-1]["lanes"])]
    best = min(last, key=lambda row: row["seconds_per_lane_epoch"])["width"]
    choice = {"backend": jax.default_backend(), "best_width": best, "default_width": default_width(preset)}
    widths = Table("backend", "best width", "hybrid_jax.sweep.lanes.WIDTH", title="all lanes on all devices")
    widths.add_row(*map(str, choice.values()))
    ratios = ratios_of(preset, times, choice["default_width"], best)
    return Findings([*rows, choice], [table_of(rows), widths], ratios)


if __name__ == "__main__":
    run("sweep", __doc__, PRESETS, measure)
