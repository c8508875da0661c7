"""Figures of models on recorded flights: errors against horizon and N, a predicted flight."""

from collections.abc import Mapping
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter

from experiments.real_flight.config import NANODRONE_STEPS
from experiments.real_flight.models import thrust_baseline
from experiments.real_flight.scoring import QUANTITIES, SUM, TAGS, Cell, cell_name, cells, pooled, score_labels
from experiments.real_flight.study import Outputs
from experiments.real_flight.train import Experiment, TrainedModel
from experiments.reporting.plots import COLOURS, PAGE, STYLE, legend_below, subplots, tick_errors
from experiments.reporting.results import Results
from hybrid_jax.flights.log import segments
from hybrid_jax.flights.windows import cut_windows, flight_of, require_length
from hybrid_jax.integrate import rollout_batch
from hybrid_jax.state import BODY_RATES, VELOCITY

MODEL_COLOURS = COLOURS | {"chosen": "#E69F00", "linear_residual": "#CC79A7", "thrust": "0.35", "hold": "0.65"}
DASHES = {"fine_tuned": "-", "source_only": "-", "scratch": "--", "zero_shot": ":", "nominal": "-."}
BASELINE: Cell = ("thrust", "nominal", 0)  # thrust with frozen body rates, which errors are drawn over
WORST = 4.0  # times its error: no curve is drawn beyond
MARGIN = 1.5  # factor in N on both sides of a single one
PIECES = 6  # predictions in the figure of a flight


def make_figures(experiment: Experiment, outputs: Outputs) -> dict[str, tuple[Figure, str]]:
    """Draw all figures: name → figure and caption."""
    nanodrone, rows = experiment.config.protocol == "nanodrone", outputs.table
    caption = f"mean error over {NANODRONE_STEPS} steps" if nanodrone else "RMSE"
    steps = f"Error against horizon over that of thrust with frozen rates, {caption}, test flights of all folds"
    figures = {"errors_by_step": (errors_by_step(experiment, outputs), steps)}
    if any(rows["n_train"]):
        by_size = errors_by_size(rows, experiment.dt, "Error against the amount of target flight")
        figures["errors_by_size"] = (by_size, "Error over that of thrust with frozen rates, against N, target windows")
    modes = ("fine_tuned", "source_only", "zero_shot")
    hybrids = {mode: outputs.trained[0, "hybrid", mode] for mode in modes if (0, "hybrid", mode) in outputs.trained}
    if hybrids:
        flight = predicted_flight(experiment, outputs, next(iter(hybrids)))
        figures["predicted_flight"] = (flight, "A part of a test flight and its predictions")
    return figures


@mpl.rc_context(STYLE)
def errors_by_step(experiment: Experiment, outputs: Outputs) -> Figure:
    """A panel for each quantity: the errors of the main cells over the baseline's, against the time of prediction."""
    power, kind = (1, 1) if experiment.config.protocol == "nanodrone" else (2, 0)
    figure, panels = subplots((PAGE, 5.6), 2, 2, sharex=True)
    most = max(outputs.table["n_train"])
    curves_of = {tuple(test.row[tag] for tag in TAGS): test.errors[kind] for test in outputs.tests}

    def curves(group: Results) -> np.ndarray:
        """Of each seed and quantity, over the test windows of all folds."""
        by_seed = []
        for own in group.group("seed").values():
            weights = own.numbers("windows")
            errors = np.array([curves_of[tuple(row[tag] for tag in TAGS)] for row in own])
            by_seed.append((np.tensordot(weights, errors**power, 1) / weights.sum()) ** (1 / power))
        return np.array(by_seed)

    found = cells(outputs.table)
    baseline = curves(found[BASELINE]).mean(axis=0)
    for cell, group in found.items():
        model, mode, n = cell
        if cell == BASELINE or n not in (0, most) or (mode == "scratch" and model not in ("hybrid", "linear_residual")):
            continue
        by_seed = curves(group) / baseline
        for axes, mean, std in zip(panels.flat, np.mean(by_seed, axis=0), np.std(by_seed, axis=0), strict=True):
            time, low = experiment.dt * np.arange(1, len(mean) + 1), np.maximum(mean - std, 0.5 * mean)
            axes.plot(time, mean, DASHES[mode], color=MODEL_COLOURS[model], label=cell_name(*cell))
            axes.fill_between(time, low, mean + std, color=MODEL_COLOURS[model], alpha=0.15, linewidth=0)
    for axes, name in zip(panels.flat, QUANTITIES, strict=True):
        axes.set(title=name.replace("_", " ").capitalize(), ylabel="error / baseline")
        _over_baseline(axes)
    for axes in panels[1]:
        axes.set_xlabel("time since the start of the prediction [s]")
    return legend_below(figure, "Error over that of thrust with frozen rates", "mean over seeds; band: ± std")


@mpl.rc_context(STYLE)
def errors_by_size(rows: Results, dt: float, title: str) -> Figure:
    """A row of panels for each horizon: the error over the baseline's against N; models without N are lines."""
    found, labels = cells(rows), score_labels(rows)
    sizes = sorted({n for _, _, n in found} - {0})
    figure, panels = subplots((PAGE, 1.2 + 1.9 * len(labels)), len(labels), len(QUANTITIES), sharex=True)
    for label, line in zip(labels, panels, strict=True):
        when = "summed over 50 steps" if label == SUM else f"{int(label) * dt:.3g} s"
        for name, axes in zip(QUANTITIES, line, strict=True):
            _draw_sizes(axes, found, sizes, label, name)
            axes.set_title(f"{name.replace('_', ' ').capitalize()}, {when}")
        line[0].set_ylabel("error / baseline")
    for axes in panels[-1]:
        axes.set(xscale="log", xlabel="N, target windows")
        axes.set_xticks(sizes, [str(size) for size in sizes])
        axes.xaxis.set_minor_formatter(NullFormatter())
        if len(sizes) == 1:
            axes.set_xlim(sizes[0] / MARGIN, sizes[0] * MARGIN)
    return legend_below(figure, title, "over thrust with frozen rates; mean over seeds; band: ± std", columns=3)


@mpl.rc_context(STYLE)
def predicted_flight(experiment: Experiment, outputs: Outputs, mode: str) -> Figure:
    """Velocity and body rates of a part of one test flight, and predictions that restart from it at intervals."""
    config, dt = experiment.config, experiment.dt
    log = require_length(outputs.folds[0].test, config.longest)[0]
    part = max(segments(log), key=lambda part: part.stop - part.start)
    windows = cut_windows([log[part]], config.longest, config.longest).windows
    first = _liveliest(np.asarray(windows.x)[..., VELOCITY.start :], PIECES)
    begin = log.t[part.start] - log.t[0] + first * config.longest * dt
    windows = windows[first : first + PIECES]
    fields = {(model, mode): _largest(outputs.trained[0, model, mode]) for model in config.models}
    fields["thrust", "nominal"] = thrust_baseline(experiment.after)
    truth = np.concatenate([windows.x0[:1], *windows.x])
    time = begin + dt * np.arange(len(truth))
    # Each prediction ends in a gap of its line.
    at = time[:: config.longest][: len(windows), None] + dt * np.arange(config.longest + 2)
    gap, states = np.full((len(windows), 1, 13), np.nan), {}
    for cell, field in fields.items():
        predicted = rollout_batch(field, windows.x0, windows.u, windows.dt)
        states[cell] = np.concatenate([windows.x0[:, None], predicted, gap], axis=1)
    figure, panels = subplots((PAGE, 4.4), 2, 3, sharex=True)
    names = ("vx", "vy", "vz", "ωx", "ωy", "ωz")
    for axes, place, name in zip(panels.flat, range(VELOCITY.start, BODY_RATES.stop), names, strict=True):
        axes.plot(time, truth[:, place], color="black", linewidth=1.6, label="measured")
        low, high = truth[:, place].min(), truth[:, place].max()
        room = 0.5 * (high - low) or 1.0
        for cell, pieces in states.items():
            style = {"color": MODEL_COLOURS[cell[0]], "linewidth": 1.2, "label": cell_name(*cell)}
            axes.plot(at.ravel(), pieces[..., place].ravel(), **style)
        axes.plot(at[:, 0], windows.x0[:, place], ".", color="black", markersize=4)
        axes.set(title=f"{name} [{'m/s' if name[0] == 'v' else 'rad/s'}]", ylim=(low - room, high + room))
    for axes in panels[1]:
        axes.set_xlabel("time in flight [s]")
    title = f"Test flight {flight_of(log)}, predicted {dt * config.longest:.3g} s at a time"
    return legend_below(figure, title, "each prediction starts at a dot, from the measured state")


def _liveliest(motion: np.ndarray, pieces: int) -> int:
    """The first of so many windows (n, t, k) in a row in which the vehicle moves most: each channel by its spread."""
    scaled = motion / (motion.std(axis=(0, 1)) + 1e-9)
    starts = range(max(len(motion) - pieces, 0) + 1)
    return max(starts, key=lambda i: float(scaled[i : i + pieces].std(axis=(0, 1)).mean()))


def _over_baseline(axes: Axes) -> None:
    """A log axis of ratios up to WORST, with the baseline as a line."""
    axes.axhline(1.0, color=MODEL_COLOURS[BASELINE[0]], linestyle=DASHES[BASELINE[1]], label=cell_name(*BASELINE))
    axes.set_yscale("log")
    low, high = axes.get_ylim()
    axes.set_ylim(low, min(high, WORST))
    tick_errors(axes.yaxis, *axes.get_ylim(), room=2.0)


def _largest(trained: TrainedModel) -> Any:
    """The field of the first seed with the most windows."""
    return trained.run(int(np.argmax([len(subset) for subset in trained.subsets])))


def _draw_sizes(axes: Axes, found: Mapping[Cell, Results], sizes, label: str, quantity: str) -> None:
    drawn = dict.fromkeys((model, mode) for model, mode, _ in found)
    baseline = pooled(found[BASELINE], label, quantity).mean()
    for model, mode in drawn:
        if (model, mode) == BASELINE[:2]:
            continue
        own = {
            n: pooled(found[model, mode, n], label, quantity) / baseline
            for n in (0, *sizes)
            if (model, mode, n) in found
        }
        style: Any = {"color": MODEL_COLOURS[model], "linestyle": DASHES[mode], "label": cell_name(model, mode)}
        if 0 in own:
            axes.axhline(own[0].mean(), linewidth=1.2, **style)
            continue
        spread = np.array([values.std(ddof=1) if len(values) > 1 else 0.0 for values in own.values()])
        at, means = list(own), np.array([values.mean() for values in own.values()])
        axes.plot(at, means, marker="o", markersize=3, **style)
        low = np.maximum(means - spread, 0.5 * means)
        axes.fill_between(at, low, means + spread, color=MODEL_COLOURS[model], alpha=0.15, linewidth=0)
    _over_baseline(axes)
