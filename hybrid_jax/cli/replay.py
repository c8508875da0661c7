"""The verb `hybrid-jax replay`: show a flight in 3-D with the models' predictions."""

import io
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from jaxtyping import Float
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

from hybrid_jax import checks
from hybrid_jax.cli import page
from hybrid_jax.cli.command import step
from hybrid_jax.cli.logs import FlightOptions, flights_for, known_of
from hybrid_jax.flights.windows import cut_windows
from hybrid_jax.identification.learning import windows_for
from hybrid_jax.integrate import rollout_batch
from hybrid_jax.io.files import write_atomic
from hybrid_jax.io.models import load
from hybrid_jax.trajectories import Trajectories
from hybrid_jax.vehicle import POSITION

__all__ = ["Options", "run"]
SHOWN = 10  # pictures a second
TRUE, COLOURS = "0.3", ("#0072B2", "#CC79A7")
Forecasts = Mapping[str, Float[np.ndarray, "n t 3"]]


@dataclass(frozen=True)
class Options(FlightOptions):
    """Show a flight in 3-D with each model's predictions at each time, under the recorded inputs.

    The animation is on the page, and in replay.gif.
    """

    model: Annotated[Path, tyro.conf.Positional]
    """Model that `hybrid-jax fit` or `adapt` wrote."""
    flight: Annotated[Path, tyro.conf.Positional]
    """One log."""
    other: Path | None = None
    """A second model to compare. For example, give the one before adaptation."""
    ahead: float = 0.5
    """Prediction horizon [s]."""
    seconds: float = 10.0
    """Length of the flight to show [s]."""
    out: Path = Path("runs/replay")
    """Folder for report.html and report.json."""


def run(options: Options) -> int:
    for name in ("ahead", "seconds"):
        checks.positive(f"--{name}", getattr(options, name), "a positive number of seconds")
    models = {path: known_of(path, load(path)) for path in (options.model, options.other) if path is not None}
    first = models[options.model]
    logs = flights_for(first, options.flight, options, changed=True, unseen=False).logs
    if len(logs) > 1:
        raise ValueError(f"{options.flight}: has {len(logs)} flights; give one of them")
    steps, every = max(1, round(options.ahead / first.dt)), max(1, round(1 / SHOWN / first.dt))
    shown = slice(max(1, round(options.seconds * SHOWN)))
    windows = cut_windows(logs, steps, every)[shown]
    with step(f"predicting and drawing {len(windows)} pictures"):
        forecasts = {
            str(path): np.asarray(rollout_batch(known.field, each.x0, each.u, each.dt))[..., POSITION]
            for path, known in models.items()
            for each in [windows_for(known.field, logs[0], steps, every)[shown]]
        }
        picture = _animated(windows, forecasts, every * windows.dt)
        write_atomic(options.out / "replay.gif", picture)
    ends = {name: np.linalg.norm(each[:, -1] - windows.x[:, -1, POSITION], axis=1) for name, each in forecasts.items()}
    rms = {name: float(np.sqrt(np.mean(np.square(each)))) for name, each in ends.items()}
    rows = [(name, f"{rms[name]:.3g} m", f"{np.max(each):.3g} m") for name, each in ends.items()]
    seconds = steps * windows.dt
    result = page.Page(
        f"Where do models expect the vehicle of {options.flight.name}?",
        f"After {seconds:g} s it is {rms[str(options.model)]:.3g} m from where {options.model.name} expects it.",
        page.Table(f"Distance after {seconds:g} s", ("model", "RMS", "largest"), rows),
        [("The flight, and what models expect next, in real time", picture)],
        ["Each line begins where the vehicle is, and ends where a model expects it under the recorded inputs."],
        [f"Over whole flights and against baselines: hybrid-jax check {options.model} FLIGHTS."],
    )
    page.write(options.out, "replay", result, {"distance": rms, "files": [options.out / "replay.gif"]})
    return 0


def _animated(windows: Trajectories, forecasts: Forecasts, dt: float) -> bytes:
    path = np.asarray(windows.x0)[:, POSITION]
    middle, half = (path.min(axis=0) + path.max(axis=0)) / 2, max(0.6, 0.6 * np.ptp(path, axis=0).max())
    figure = Figure(figsize=(6.4, 5.2), layout="constrained")
    canvas = FigureCanvasAgg(figure)
    axes = figure.add_subplot(projection="3d")
    limits = np.stack([middle - half, middle + half]).T
    axes.set(xlim=limits[0], ylim=limits[1], zlim=limits[2], xlabel="x [m]", ylabel="y [m]", zlabel="z [m]")
    (trail,) = axes.plot([], [], [], color=TRUE, linewidth=1.2, label="flown")
    (vehicle,) = axes.plot([], [], [], "o", color=TRUE, markersize=6)
    nexts = [axes.plot([], [], [], color=each, label=name)[0] for name, each in zip(forecasts, COLOURS, strict=False)]
    axes.legend(loc="upper left", fontsize=8)

    pictures = []
    for i in range(len(path)):
        figure.suptitle(f"{i * dt:.1f} s")
        points = path[: i + 1], path[i : i + 1], *(each[i] for each in forecasts.values())
        for line, place in zip((trail, vehicle, *nexts), points, strict=True):
            shown = np.where(np.abs(place - middle) < 4 * half, place, np.nan)
            line.set_data_3d(*shown.T)  # pyright: ignore[reportAttributeAccessIssue]
        canvas.draw()
        pictures.append(Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB"))
    content = io.BytesIO()
    pictures[0].save(content, "GIF", save_all=True, append_images=pictures[1:], duration=round(1000 * dt), loop=0)
    return content.getvalue()
