"""report.html in a browser: no error, every figure visible, tables that sort; and tables for a paper."""

import json
import re
import shutil
import subprocess

import pytest
from matplotlib.figure import Figure
from reports import make_report, make_rows

from experiments.reporting.latex import escaped, latex
from experiments.reporting.plots import save_figures
from experiments.reporting.report import write_report
from experiments.reporting.tables import Table, best_cells

BROWSER = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
# Before and after the page: errors are collected, then a header is clicked and what is there is written down.
BEFORE = "<script>const wrong = []; onerror = (...error) => wrong.push(String(error)); console.error = onerror</script>"
AFTER = """<script>addEventListener("load", () => {
  const table = document.querySelector("table"), images = [...document.images]
  const column = i => [...table.rows].slice(1).map(row => row.cells[i].textContent), before = column(1)
  table.tHead.rows[0].cells[1].click()
  const shown = images.map(image => image.naturalWidth * image.getBoundingClientRect().height > 0)
  images[0].click()
  const zoomed = document.querySelectorAll("figure.zoomed").length
  document.body.innerHTML = "<pre>" + JSON.stringify({wrong, shown, before, after: column(1), zoomed}) + "</pre>"
})</script>"""


@pytest.fixture
def written(tmp_path):
    figures = {}
    for name in ("one", "two"):
        figure = Figure()
        figure.subplots().plot([1, 2], [3, 4])
        figures[name] = figure, f"The {name} & only <figure>"
    captions = save_figures(tmp_path, figures, paper=True)
    write_report(tmp_path, make_report(make_rows(), figures=captions, notes=["a < b"]), paper=True)
    return tmp_path


def test_it_needs_nothing_but_itself(written):
    page = (written / "report.html").read_text()
    assert re.findall(r"(?:src|href)=\"(?!data:)[^\"]*|url\(|@import|fetch\(", page) == []
    assert page.index('class="conclusion"') < page.index("<table")
    assert "hypotheses hold" in page
    assert "<details><summary>Configuration</summary>" in page
    assert "The one &amp; only &lt;figure&gt;" in page
    assert "a &lt; b" in page


@pytest.mark.skipif(BROWSER is None, reason="no Chromium")
def test_a_browser_shows_every_figure_and_sorts_without_an_error(written):
    page = (written / "report.html").read_text()
    (written / "watched.html").write_text(
        page.replace("<head>", f"<head>{BEFORE}").replace("</body>", f"{AFTER}</body>")
    )
    options = ["--headless", "--no-sandbox", "--disable-gpu", f"--user-data-dir={written / 'browser'}", "--dump-dom"]
    address = (written / "watched.html").as_uri()
    run = [BROWSER, *options, "--virtual-time-budget=5000", address]
    found = subprocess.run(run, capture_output=True, text=True, timeout=120, check=True).stdout
    seen = json.loads(re.search(r"<pre>(.*?)</pre>", found, flags=re.DOTALL)[1])
    assert seen["wrong"] == []
    assert seen["shown"] == [True, True]
    assert seen["zoomed"] == 1
    numbers = [float(text.split()[0]) for text in seen["after"]]
    assert numbers == sorted(numbers)
    assert seen["before"] != seen["after"]


def test_the_smallest_number_is_the_best():
    lines = [("a", "0.3 ± 0.1", "(3.2 ± 0.2)e-04"), ("b", "0.067 ± 0.009", "–"), ("c", "∞ (1 of 2 seeds)", "0.002")]
    assert best_cells(Table("t", ("", "x", "y"), lines, "column")) == {(1, 1), (0, 2)}
    assert best_cells(Table("t", ("", "x", "y"), lines, "line")) == {(0, 2)}
    assert best_cells(Table("t", ("", "x", "y"), lines)) == set()


def test_a_paper_gets_its_tables_and_drawings(written):
    assert (written / "one.pdf").read_bytes().startswith(b"%PDF")
    tables = {path.name: path.read_text() for path in (written / "paper").iterdir()}
    assert len(tables) == 4
    assert r"\textbf{0.0220 $\pm$ 0.0004}" in tables["test_error_l_t_mse.tex"]
    for text in tables.values():
        rows = [line for line in text.splitlines() if line.endswith(r"\\")]
        assert len({len(re.findall(r"(?<!\\)&", row)) for row in rows}) == 1


def test_nothing_of_a_text_is_a_command_of_latex():
    assert escaped("50 % of θ_p & {x} ± $1 ~ #2^3 \\a") == (
        r"50 \% of $\theta$\_p \& \{x\} $\pm$ \$1 \textasciitilde{} \#2\textasciicircum{}3 \textbackslash{}a"
    )
    assert "booktabs" not in latex(Table("t", ("a",), [("b",)]))
