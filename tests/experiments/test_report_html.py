"""report.html of an experiment, and tables for a paper."""

import re

import pytest
from matplotlib.figure import Figure
from reports import make_report, make_rows

from experiments.reporting.latex import escaped, latex
from experiments.reporting.plots import save_figures
from experiments.reporting.report import write_report
from experiments.reporting.tables import Table, best_cells


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


def test_the_page_is_that_of_the_script(written):
    page = (written / "report.html").read_text()
    assert page.index("hypotheses hold") < page.index("<img") < page.index("<table")
    assert "<details><summary>Configuration</summary>" in page
    assert page.count("data:image/png;base64,") == 2
    assert "The one &amp; only &lt;figure&gt;" in page
    assert "a &lt; b" in page


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
