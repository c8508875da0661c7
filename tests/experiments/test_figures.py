"""Figures show the numbers of the rows, also of failed runs, and are reproducible."""

import io
import json

import matplotlib as mpl
import numpy as np
import PIL.Image
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from reports import ODD_ROWS, make_rows

from experiments.paper.figures import ranking, scores
from experiments.redraw import REFERENCE, drawn
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
