"""Figures show the numbers of the rows, also of failed runs, and are reproducible."""

import io

import matplotlib as mpl
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from reports import ODD_ROWS, make_rows

from experiments.paper.figures import ranking, scores
from experiments.reporting.plots import save_figures


def test_figures_are_reproducible_and_keep_matplotlibs_settings(tmp_path):
    before = dict(mpl.rcParams)
    captions = save_figures(
        tmp_path, {name: (scores(make_rows(), "Scores", floor=0.01), "A figure") for name in ("one", "two")}
    )
    assert captions == dict.fromkeys(("one.png", "two.png"), "A figure")
    assert (tmp_path / "one.png").read_bytes() == (tmp_path / "two.png").read_bytes()
    assert (tmp_path / "one.png").read_bytes().startswith(b"\x89PNG")
    assert dict(mpl.rcParams) == before


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
