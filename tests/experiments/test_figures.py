"""Figures show the numbers of the rows, also of failed runs, and are reproducible."""

import io
import json
import math

import matplotlib as mpl
import numpy as np
import PIL.Image
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from reports import ODD_ROWS, SIZES, changed, make_rows
from test_ranking import compared_rows, spoilt

from experiments.paper.figures import ranking, scores
from experiments.paper.flight_figures import parted, predictions
from experiments.redraw import REFERENCE, drawn
from experiments.reporting.plots import LARGEST_RATIO, save_figures


def straight_flight(steps=10):
    """Along x at 1 m/s, level, one state each 0.1 s."""
    states = np.zeros((steps + 1, 13))
    states[:, 0] = 0.1 * np.arange(steps + 1)
    states[:, 2:4] = 1.0
    states[:, 7] = 1.0
    return states


def test_figures_are_reproducible_and_keep_matplotlibs_settings(tmp_path):
    before = dict(mpl.rcParams)
    captions = save_figures(
        tmp_path, {name: (scores(make_rows(), "Scores", floor=0.01), "A figure") for name in ("one", "two")}
    )
    assert captions == dict.fromkeys(("one.png", "two.png"), "A figure")
    assert (tmp_path / "one.png").read_bytes() == (tmp_path / "two.png").read_bytes()
    assert (tmp_path / "one.png").read_bytes().startswith(b"\x89PNG")
    assert dict(mpl.rcParams) == before


def labels(axes):
    return axes.get_legend_handles_labels()[1]


def test_scores_show_every_mean():
    left, right = scores(make_rows(), "Scores").axes
    assert set(labels(left)) == {
        f"{model}, {mode}"
        for model in ("hybrid", "no-physics")
        for mode in ("fine-tuned", "target-only", "source-only")
    }
    assert left.get_yscale() == "log"
    handles = dict(zip(labels(left), left.get_legend_handles_labels()[0], strict=True))
    assert handles["hybrid, fine-tuned"].get_ydata() == pytest.approx([0.022, 0.018, 0.016])
    assert [tick.get_text() for tick in right.get_xticklabels()] == [str(n) for n in SIZES]


def test_failed_seeds_are_marked_and_axes_stay_readable():
    rows = changed(make_rows(), "no_physics", "fine_tuned", 100, factor=1e9)
    rows = changed(rows, "no_physics", "fine_tuned", 500, test_mse=math.nan)
    left, right = scores(rows, "Scores").axes
    assert left.get_ylim()[1] <= 0.016 * 1e6 * 1.001
    assert right.get_ylim()[0] >= -1.2
    for axes in (left, right):
        words = " ".join(text.get_text() for text in axes.texts)
        assert "3/3 not finite" in words
        assert "e+09" in words


def methods_of(axes):
    return [tick.get_text() for tick in axes.get_yticklabels()]


def test_ranking_has_a_line_per_method_best_first():
    shift, force = ranking(compared_rows(), "Ranking").axes
    assert methods_of(shift)[:3] == ["hybrid", "Expert Augmentation", "physics-only"]
    assert methods_of(shift)[-1] == "hybrid, source-only"
    assert set(methods_of(force)) == set(methods_of(shift))
    assert shift.yaxis_inverted()
    assert (shift.get_xscale(), shift.get_title(), force.get_title()) == ("log", "Other inertia", "Side wind")
    dots = [line for line in shift.lines if line.get_marker() == "o"]
    assert [len(line.get_xdata()) for line in dots] == [3] * len(methods_of(shift))
    assert dots[0].get_xdata() == pytest.approx([3.26e-3 * factor for factor in (0.99, 1, 1.01)])


def test_ranking_names_n_if_there_are_several():
    (axes,) = ranking(make_rows(), "Ranking").axes
    assert {"hybrid, N = 100", "hybrid, N = 1000", "hybrid, source-only"} < set(methods_of(axes))


def test_failed_methods_are_marked_at_the_edge_of_the_ranking():
    rows = spoilt(compared_rows(), "last_layer", lambda row: math.nan)
    rows = spoilt(rows, "theta_d_only", lambda row: math.inf if row["seed"] else row["test_mse"])
    rows = spoilt(rows, "linear_residual", lambda row: 1e9 * row["test_mse"])
    axes = ranking(rows, "Ranking").axes[0]
    assert axes.get_xlim()[1] < 3.26e-3 * LARGEST_RATIO * 1.2
    assert methods_of(axes)[-3:] == ["source + linear residual", "$\\theta_d$ only", "last layer (ridge)"]
    words = [text.get_text() for text in axes.texts]
    assert words == ["3 of 3 beyond, mean 5e+06", "2 of 3 not finite", "3 of 3 not finite"]


def test_predictions_show_quantiles_of_flights_and_one_flight_from_above():
    truth = np.stack([straight_flight()] * 5)
    near, off, lost = truth.copy(), truth.copy(), truth.copy()
    near[:, 1:, 1] += 0.1 * np.arange(5)[:, None]  # of the flights 0 … 0.4 m off
    off[:, 5:, 1] = 1e30
    lost[:, 3:] = math.nan
    predicted = {100: {"no_physics": off, "hybrid": near}, 1000: {"hybrid": lost}}
    above, few, _, many = predictions(parted(predicted, truth, 0, 0.1), "Flights").axes
    curves = {line.get_label(): line.get_ydata() for line in few.lines}
    assert curves["hybrid"] == pytest.approx(np.full(10, 0.2))
    assert few.get_ylim() == many.get_ylim()
    assert few.get_ylim()[1] <= 100
    assert np.ptp(above.get_xlim()) == pytest.approx(1.3)
    ends = [line.get_marker() for line in above.lines if line.get_marker() in "ox" and line.get_label()[0] == "_"]
    assert ends == ["x", "o"]  # where a prediction leaves the box, and where it ends


@settings(max_examples=6, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(rows=ODD_ROWS, floor=st.floats(0, 1e6))
def test_any_rows_are_drawn(rows, floor):
    compared = rows
    rows = rows.where(domain="parameter_shift")
    drawn = (
        (rows, lambda: scores(rows, "Scores", floor)),
        (compared, lambda: ranking(compared, "Ranking", {"external_force": floor})),
    )
    for enough, draw in drawn:
        if len(enough):
            draw().savefig(io.BytesIO(), format="png", dpi=30)


REPORTS = sorted(path.parent for path in REFERENCE.rglob("report.json"))


@pytest.mark.slow
@pytest.mark.parametrize("folder", REPORTS, ids=lambda folder: str(folder.relative_to(REFERENCE)))
def test_committed_pictures_are_what_the_code_draws(folder, tmp_path):
    """Run `python -m experiments.redraw` if a figure's program has changed."""
    captions = save_figures(tmp_path, drawn(folder))
    assert json.loads((folder / "report.json").read_text())["figures"] == captions
    assert {path.name for path in folder.iterdir() if path.suffix in (".png", ".gif", ".svg")} == captions.keys()
    for name in captions:
        assert f"]({name})" in (folder / "report.md").read_text()
        own, committed = (PIL.Image.open(path / name).convert("RGB") for path in (tmp_path, folder))
        assert own.size == committed.size
        # Another version of matplotlib may draw a letter elsewhere.
        assert np.abs(np.asarray(own, float) - np.asarray(committed, float)).mean() < 2
