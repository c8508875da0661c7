"""Tables and figure of an identification."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from jaxtyping import Float, Int
from matplotlib.figure import Figure

from experiments.reporting.plots import STYLE, save_figure
from experiments.reporting.tables import Table
from hybrid_jax.flights.attitude import interpolate, interpolate_attitude, rotation_of
from hybrid_jax.flights.recording import AXES, ROTOR_UNITS, Recording
from hybrid_jax.identification import slow_commands
from hybrid_jax.identification.fitting import Identified, prediction_errors
from hybrid_jax.identification.recordings import Layout

DRAGGED = 0.6  # correlation of forces with the velocity from which on they are drag


def tables(found: Identified, logs: Sequence[Recording], left_out: Sequence[Recording], layout: Layout, names):
    """Rows of the result, its tables and its notes."""
    units = found.field.parameter_units
    rows: list[dict[str, Any]] = []
    for name, interval in found.intervals.items():
        value, low, high = (float(each) for each in interval)
        rows.append({"parameter": name, "value": value, "low": low, "high": high})
    lines = [
        (row["parameter"], *(f"{row[key]:.4g}" for key in ("value", "low", "high")), units.get(_plain(row), ""))
        for row in rows
    ]
    shown = [Table("Parameters, with 95 % intervals", ("parameter", "estimate", "from", "to", "unit"), lines)]
    shown.append(Table("RMS of the errors over the windows fitted", ("quantity", "unit", "x, y, z …"), _fitted(found)))
    shown += [_predicted(found, each, layout, names) for each in left_out]
    unseen = [row["parameter"] for row in rows if not np.isfinite(row["high"])]
    notes = [f"{found.windows} windows, {found.seconds:.4g} s of flight, of {len(logs)} logs"]
    with_commands = [log for log in logs if "command" in log.signals]
    slow = [log.signals["command"].interval for log in with_commands if slow_commands.is_slow(log.signals["command"])]
    if slow:
        notes.append(
            f"commands {max(slow):.3g} s apart: they changed in between, which the intervals count; a delay and a lag "
            "are hardly told apart by such a log"
        )
    if unseen:
        notes.append(f"not told by these logs, left as they were: {', '.join(unseen)}")
    shares = ", ".join(f"{axis} {share:.2f}" for axis, share in zip("xyz", found.explained, strict=True))
    notes.append(
        f"share of the body rates within a window, less their trend, that commands explain: {shares}; inertia and "
        "torque have intervals that hold both regressions, of torque on acceleration and the other way round"
    )
    if "drag" not in {_plain(row) for row in rows} and (dragged := unlearned_drag(logs)):
        notes.append(dragged)
    if not found.converged:
        notes.append("the fit stopped before it converged: start nearer, or learn less")
    return rows, shown, notes


def unlearned_drag(logs: Sequence[Recording]) -> str:
    """What is to be said where forces across the thrust follow the velocity; empty where they do not."""
    both = [pair for log in logs if (pair := _across(log)) is not None]
    if not both:
        return ""
    force, velocity = (np.concatenate(each) for each in zip(*both, strict=True))
    slope = (force * velocity).sum() / max((velocity**2).sum(), 1e-12)
    correlation = (force * velocity).sum() / max(np.sqrt((force**2).sum() * (velocity**2).sum()), 1e-12)
    if correlation > -DRAGGED:
        return ""
    told = f"specific force across the thrust is {slope:.2g} v (correlation {correlation:.2f})"
    return f"{told}: drag, which is not learned, so lag and inertia take it up: learn drag as well"


def _across(log: Recording) -> tuple[np.ndarray, np.ndarray] | None:
    """Specific force and velocity along x and y of the body, if both were measured."""
    signals = log.signals
    force, q = signals.get("specific_force"), signals.get("attitude")
    if force is None or force.axes != ("x", "y", "z") or not {"velocity", "body_velocity"} & signals.keys():
        return None
    if "body_velocity" in signals:
        own = signals["body_velocity"]
        return force.values[:, :2], interpolate(force.t, own.t, own.values)[:, :2]
    if q is None:
        return None
    inside = (force.t >= q.t[0]) & (force.t <= q.t[-1])
    t, own = force.t[inside], signals["velocity"]
    turned = rotation_of(interpolate_attitude(t, q.t, q.values)).inv().apply(interpolate(t, own.t, own.values))
    return force.values[inside, :2], turned[:, :2]


def _plain(row) -> str:
    return row["parameter"].partition("[")[0]


def _unit(name: str) -> str:
    return "rad" if name == "attitude" else AXES[name][1] if name in AXES else ROTOR_UNITS[name]


def _fitted(found: Identified):
    return [(name, _unit(name), "  ".join(f"{e:.3g}" for e in errors)) for name, errors in found.errors.items()]


def _predicted(found: Identified, recording: Recording, layout: Layout, names) -> Table:
    errors = prediction_errors(found.field, [recording], layout, names)
    asked = max(1, layout.steps // 4), layout.steps
    lines = [(name, _unit(name), *(_nearest(part, step, layout.dt) for step in asked)) for name, part in errors.items()]
    ends = [f"after {layout.dt * step:.3g} s" for step in asked]
    return Table(f"RMS of what was predicted of {Path(recording.name).name}", ("quantity", "unit", *ends), lines)


def _by_step(part: Float[np.ndarray, "n t k"]) -> tuple[Int[np.ndarray, " m"], Float[np.ndarray, "m k"]]:
    """The steps, from 1, at which something was measured in any window, and the RMS of the errors there."""
    steps = np.flatnonzero(~np.isnan(part).all(axis=(0, 2)))
    return steps + 1, np.sqrt(np.nanmean(part[:, steps] ** 2, axis=0))


def _nearest(part: Float[np.ndarray, "n t k"], asked: int, dt: float) -> str:
    """The errors at the measured step that is nearest to the one asked for, with its time if it is another."""
    steps, errors = _by_step(part)
    if not len(steps):
        return "not measured"
    at = int(np.abs(steps - asked).argmin())
    shown = "  ".join(f"{each:.3g}" for each in errors[at])
    return shown if steps[at] == asked else f"{shown} ({dt * steps[at]:.3g} s)"


def figure(out: Path, found: Identified, logs, left_out, layout: Layout, names) -> dict[str, str]:
    """Errors of predictions against time, of logs left out where there are any; path → caption."""
    errors = prediction_errors(found.field, left_out or logs, layout, names)
    with mpl.rc_context(STYLE):
        picture = Figure(figsize=(3.2 * len(errors), 2.8), layout="constrained")
        for panel, (name, part) in zip(np.atleast_1d(picture.subplots(1, len(errors))), errors.items(), strict=True):
            steps, rms = _by_step(part)
            axes = logs[0].signals[name].axes if name != "attitude" else ("x", "y", "z")
            panel.plot(layout.dt * steps, rms, marker="." if len(steps) < part.shape[1] else None, label=axes)
            panel.set(xlabel="time from the start [s]", ylabel=f"RMS error [{_unit(name)}]", title=name)
            panel.legend()
        save_figure(picture, out / "errors")
    which = "logs left out" if left_out else "the logs fitted"
    return {"errors.png": f"Errors of predictions from the state that earlier samples tell: {which}."}
