"""A committed report is what the program makes of its record: words, numbers, verdicts and figures."""

import json

import numpy as np
import PIL.Image
import pytest

from experiments.redraw import REFERENCE, report_of, written
from experiments.reporting.plots import save_figures

FOLDERS = [
    pytest.param(path.parent, marks=[pytest.mark.slow] * (path.parent.name == "closed_loop"))
    for path in sorted(REFERENCE.rglob("report.json"))
]
of_each_report = pytest.mark.parametrize("folder", FOLDERS, ids=lambda path: str(path.relative_to(REFERENCE)))


@of_each_report
def test_its_text_is_what_the_program_writes(folder):
    """Run `python -m experiments.redraw` if a report's program has changed."""
    report, record = report_of(folder), json.loads((folder / "report.json").read_text())
    for name, text in written(folder, report).items():
        assert (folder / name).read_text() == text
    assert record["figures"] == report.captions()
    shown = report.page(folder).table
    assert shown is None or len(shown.lines) <= 8
    assert all(len(line) == len(table.header) for table in report.tables for line in table.lines)


@pytest.mark.slow
@of_each_report
def test_its_pictures_are_what_the_program_draws(folder, tmp_path):
    captions = save_figures(tmp_path, report_of(folder).figures)
    assert {path.name for path in folder.iterdir() if path.suffix in (".png", ".gif", ".svg")} == captions.keys()
    for name in captions:
        assert f"]({name})" in (folder / "report.md").read_text()
        own, committed = (PIL.Image.open(path / name).convert("RGB") for path in (tmp_path, folder))
        assert own.size == committed.size
        # Another version of matplotlib may draw a letter elsewhere.
        assert np.abs(np.asarray(own, float) - np.asarray(committed, float)).mean() < 2
