"""The page of a verb in a browser, wide and on a phone: no error, every figure visible, tables within the frame."""

import json
import re
import shutil
import subprocess

import pytest
from matplotlib.figure import Figure

from hybrid_jax.cli.page import Page, Table, document, write

BROWSER = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
# Errors are collected; then all is unfolded, and what is there is written down.
BEFORE = "<script>const wrong = []; onerror = (...error) => wrong.push(String(error)); console.error = onerror</script>"
AFTER = """<script>addEventListener("load", () => {
  for (const each of document.querySelectorAll("details")) each.open = true
  const shown = [...document.images].map(one => one.naturalWidth * one.getBoundingClientRect().height > 0)
  const wide = document.documentElement.scrollWidth > innerWidth
  document.body.innerHTML = "<pre>" + JSON.stringify({wrong, shown, wide}) + "</pre>"
})</script>"""


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


@pytest.mark.skipif(BROWSER is None, reason="no Chromium")
@pytest.mark.parametrize("width", [390, 1400])
def test_a_browser_shows_it_without_an_error(page, tmp_path, width):
    shown = document(page).replace("<head>", f"<head>{BEFORE}").replace("</body>", f"{AFTER}</body>")
    (tmp_path / "watched.html").write_text(shown)
    options = ["--headless", "--no-sandbox", "--disable-gpu", f"--user-data-dir={tmp_path / 'browser'}", "--dump-dom"]
    run = [BROWSER, *options, f"--window-size={width},800", (tmp_path / "watched.html").as_uri()]
    found = subprocess.run(run, capture_output=True, text=True, timeout=120, check=True).stdout
    seen = json.loads(re.search(r"<pre>(.*?)</pre>", found, flags=re.DOTALL)[1])  # pyright: ignore[reportOptionalSubscript]
    assert seen == {"wrong": [], "shown": [True, True], "wide": False}
