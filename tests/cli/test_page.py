"""The page of a verb in a browser, wide and on a phone: no error, every figure visible, tables within the frame."""

import json
import re

import pytest
from matplotlib.figure import Figure

from hybrid_jax.cli.page import Page, Table, document, write


def drawn():
    figure = Figure()
    figure.subplots().plot([1, 2], [3, 4])
    return figure


@pytest.fixture
def page():
    wide = Table("Many < columns", [f"column {i}" for i in range(30)], [[f"{i}.123 m/s" for i in range(30)]])
    figures = [("The one & only <figure>", drawn()), ("Another", drawn())]
    return Page("What?", "This.", wide, figures, ["a < b"], ["Go on: " + "x" * 200], [wide], ["y" * 300])


def test_it_needs_nothing_but_itself(page, tmp_path, capsys):
    write(tmp_path, "check", page, {"one": 1})
    shown = (tmp_path / "report.html").read_text()
    assert re.findall(r"(?:src|href)=\"(?!data:)[^\"]*|url\(|@import|fetch\(", shown) == []
    assert shown.index("This.") < shown.index("<img") < shown.index("<table") < shown.index("<details")
    assert "The one &amp; only &lt;figure&gt;" in shown
    record = json.loads((tmp_path / "report.json").read_text())
    assert list(record) == ["format", "verb", "answer", "notes", "one"]
    assert capsys.readouterr().out.splitlines()[-1] == f"page: {tmp_path / 'report.html'}"


def test_a_browser_shows_it_without_an_error(page, seen):
    right = {"images": 2, "hidden": 0, "wide": False}
    assert seen({"page": document(page)}) == {("page", 400): right, ("page", 1400): right}
