"""A terminal and a file of any width show every word and number whole, and say at once what is being done."""

import io
import re
import time

import pytest
from reports import make_report, make_rows
from rich.cells import cell_len
from rich.console import Console
from smoke import ROOT

from experiments.coverage import pooled_table
from experiments.paper.known_body import known_body_table
from experiments.reporting.report import MEANINGLESS, write_report
from experiments.reporting.results import Results
from experiments.reporting.tables import Table, columns_of_parts, print_tables
from experiments.runner.progress import Line

ANSI = re.compile(r"\x1b\[[0-9;]*m")


def tables_of(page):
    for title, block in re.findall(
        r"^(?:## |.*<summary>)(.*?)(?:</summary>)?\n\n((?:\|.*\n)+)", page.read_text(), flags=re.MULTILINE
    ):
        header, _, *lines = (row[2:-2].split(" | ") for row in block.splitlines())
        yield Table(title, header, lines)


@pytest.mark.parametrize("name", ["param_shift", "comparison", "closed_loop", "real_flight/payload"])
def test_no_word_is_broken(name):
    for table in tables_of(ROOT / "docs" / "reference" / name / "report.md"):
        assert_whole(table, 80, True)


def test_nor_in_the_tables_of_coverage():
    """Of which no report is kept: the longest names and numbers that it can have."""
    tags = {"domain": "load_and_wind", "noise": "1", "parameter": "k", "draw": 0}
    numbers = {"inside": True, "alone": 1.0, "error": -123.45, "half_width": 1234.56}
    known = {"coverage": 0.5, "standard_error": 0.05, "bias": -12.3, "half_width": 123.4, "converged": 1.0}
    case = {"case": "exact physics", "noise_on": "targets", "parameter": "Ix"}
    for table in (pooled_table(Results([tags | numbers])), known_body_table(Results([case | known]))):
        assert_whole(table, 80, False)


def assert_whole(table, width, terminal):
    text = io.StringIO()
    print_tables(Console(file=text, width=width, force_terminal=terminal), [table])
    printed = ANSI.sub("", text.getvalue())
    assert max(map(cell_len, printed.splitlines())) <= width
    words = set(printed.split())
    cells = {cell for line in [table.header, *table.lines] for cell in line}
    assert [word for cell in cells for word in cell.split() if word not in words] == []


def test_a_table_that_is_too_wide_comes_in_parts_that_each_have_the_labels():
    assert columns_of_parts([9, 6, *[16] * 6], 2, 79) == [[0, 1, 2, 3, 4, 5], [0, 1, 6, 7]]
    assert columns_of_parts([9, 6, *[16] * 6], 2, 199) == [[*range(8)]]


def test_a_smoke_run_shows_no_verdict(tmp_path):
    text = io.StringIO()
    report = make_report(make_rows())
    write_report(tmp_path, report, Console(file=text, width=100))
    assert "holds" in text.getvalue()
    report.config["preset"] = "smoke"
    text = io.StringIO()
    write_report(tmp_path, report, Console(file=text, width=200))
    for shown in (text.getvalue(), (tmp_path / "report.md").read_text(), (tmp_path / "report.html").read_text()):
        assert MEANINGLESS in shown
        assert not re.search(r"✓ holds|✗ fails|– undecided", shown)
    assert text.getvalue().splitlines()[-1] == f"Report: {tmp_path / 'report.html'}"


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


def test_a_short_stage_adds_no_line_to_a_file():
    text = io.StringIO()
    with Line("a stage", Console(file=text, width=80)) as line:
        line.show_parts(1, 2)
    assert text.getvalue() == ""
