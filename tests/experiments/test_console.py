"""A terminal and a file of any width show every word and number whole, and say at once what is being done."""

import io
import re
import time

import pytest
from reports import make_report, make_rows
from rich.cells import cell_len
from rich.console import Console
from smoke import ROOT

from experiments.reporting.report import MEANINGLESS, write_report
from experiments.reporting.tables import Table, print_table
from experiments.runner.progress import Line

ANSI = re.compile(r"\x1b\[[0-9;]*m")


def tables_of(page):
    for title, block in re.findall(
        r"^(?:## |.*<summary>)(.*?)(?:</summary>)?\n\n((?:\|.*\n)+)", page.read_text(), flags=re.MULTILINE
    ):
        header, _, *lines = (row[2:-2].split(" | ") for row in block.splitlines())
        yield Table(title, header, lines)


@pytest.mark.parametrize("name", ["param_shift", "comparison", "closed_loop", "real_flight/payload"])
def test_no_word_or_number_is_broken(name):
    for table in tables_of(ROOT / "docs" / "reference" / name / "report.md"):
        for most in (0, 5):
            text = io.StringIO()
            print_table(Console(file=text, width=80, force_terminal=True), table, most)
            *printed, _ = ANSI.sub("", text.getvalue().partition("Not shown")[0]).splitlines()
            assert max(map(cell_len, printed)) <= 80
            cells = " ".join(cell.replace(" ± ", "±") for line in [table.header, *table.lines] for cell in line)
            words = {*cells.split(), *table.title.split()}
            assert {word for line in printed for word in line.split() if not set(word) <= {"─"}} <= words


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
