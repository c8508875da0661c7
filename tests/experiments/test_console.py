"""A terminal and a file show every word and number whole; a committed report is what its program makes."""

import io
import json
import re
import time

import numpy as np
import PIL.Image
import pytest
from reports import make_report, make_rows
from rich.cells import cell_len
from rich.console import Console

from experiments.redraw import REFERENCE, report_of, written
from experiments.reporting.plots import save_figures
from experiments.reporting.report import MEANINGLESS, write_report
from experiments.reporting.tables import print_table
from experiments.runner.progress import Line

ANSI = re.compile(r"\x1b\[[0-9;]*m")


def printed(table, most):
    """The words of a table at 80 columns, and those that it may have."""
    text = io.StringIO()
    print_table(Console(file=text, width=80, force_terminal=True), table, most)
    *lines, _ = ANSI.sub("", text.getvalue().partition("Not shown")[0]).splitlines()
    assert max(map(cell_len, lines)) <= 80
    cells = " ".join(cell.replace(" ± ", "±") for line in [table.header, *table.lines] for cell in line)
    shown = {word for line in lines for word in line.split() if not set(word) <= {"─"}}
    return shown, {*cells.split(), *table.title.split()}


def test_a_terminal_shows_a_headline_one_table_and_the_reports_path(tmp_path):
    text = io.StringIO()
    report = make_report(make_rows())
    write_report(tmp_path, report, Console(file=text, width=80))
    headline, *_, path = text.getvalue().splitlines()
    assert headline.startswith("With N = 100, ")
    assert path == f"Report: {tmp_path / 'report.html'}"
    assert len(text.getvalue().splitlines()) <= 24
    report.record["config"]["preset"] = "smoke"
    text = io.StringIO()
    write_report(tmp_path, report, Console(file=text, width=200))
    for shown in (text.getvalue(), (tmp_path / "report.md").read_text(), (tmp_path / "report.html").read_text()):
        assert MEANINGLESS in shown
        assert not re.search(r"✓ holds|✗ fails|– undecided", shown)
    assert "±" not in text.getvalue()


def test_a_file_says_after_a_second_what_is_being_done_and_a_terminal_at_once(monkeypatch):
    monkeypatch.setattr("experiments.runner.progress.FIRST", 0.01)
    text = io.StringIO()
    with Line("a stage", Console(file=text, width=80), "compiling"):
        until = time.monotonic() + 10
        while not text.getvalue() and time.monotonic() < until:
            time.sleep(0.01)
    assert text.getvalue() == "a stage: compiling\n"
    text = io.StringIO()
    with Line("a stage", Console(file=text, width=80, force_terminal=True), "flying") as line:
        assert "a stage: flying, 0:00 elapsed" in text.getvalue()
        line.show_share("flying", 0.5)
        assert str(line).startswith("a stage: flying 50%, 0:0")


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
    for table in report.tables:
        assert all(len(line) == len(table.header) for line in table.lines)
        for most in (0, 5):
            shown, words = printed(table, most)
            assert shown <= words


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
