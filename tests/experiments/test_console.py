"""A terminal and a file show every word and number whole; reports, committed ones too, are what their program makes."""

import io
import json
import math
import re
import time

import matplotlib as mpl
import numpy as np
import PIL.Image
import pytest
from reports import TRUTH, changed, make_report, make_rows
from rich.cells import cell_len
from rich.console import Console

from experiments.paper.figures import ranking, scores
from experiments.paper.lanes import by_altitude
from experiments.paper.study import placeholder
from experiments.redraw import REFERENCE, report_of, written
from experiments.reporting.plots import DPI, WIDTH, save_figures
from experiments.reporting.report import MEANINGLESS, read_record, write_report
from experiments.reporting.results import Results
from experiments.reporting.tables import measured, print_table
from experiments.runner.progress import Line
from experiments.runner.run_record import PACKAGES
from hybrid_jax.sim.flight import SplitSpec


def printed(table, most):
    """The words of a table at 80 columns, and those that it may have."""
    text = io.StringIO()
    print_table(Console(file=text, width=80, force_terminal=True), table, most)
    *lines, _ = re.sub(r"\x1b\[[0-9;]*m", "", text.getvalue().partition("Not shown")[0]).splitlines()
    assert max(map(cell_len, lines)) <= 80
    cells = " ".join(cell.replace(" ± ", "±") for line in [table.header, *table.lines] for cell in line)
    shown = {word for line in lines for word in line.split() if not set(word) <= {"─"}}
    return shown, {*cells.split(), *table.title.split()}


def test_a_terminal_shows_a_headline_one_table_and_the_reports_path(tmp_path):
    text, report = io.StringIO(), make_report(make_rows())
    write_report(tmp_path, report, Console(file=text, width=80))
    headline, *between, path = text.getvalue().splitlines()
    assert (headline[:14], len(between) <= 22) == ("With N = 100, ", True)
    assert path == f"Report: {tmp_path / 'report.html'}"
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
        assert own.size == committed.size == (WIDTH * DPI, own.height)  # letters that a phone shows
        # Another version of matplotlib may draw a letter elsewhere.
        assert np.abs(np.asarray(own, float) - np.asarray(committed, float)).mean() < 2


def test_report_json_keeps_the_contract_and_nothing_is_written_if_a_value_has_no_json_form(tmp_path):
    rows = changed(make_rows(seeds=1), "no_physics", "fine_tuned", 500, test_mse=math.nan, status="diverged")
    rows = rows.where(lambda row: (row["model"], row["mode"]) != ("hybrid", "target_only"))
    write_report(tmp_path, make_report(rows, wind_sine_mse=1e-3, odd=np.array([1.0, math.inf])))
    assert len((tmp_path / "rows.csv").read_text().splitlines()) == 1 + len(rows)
    json.loads((tmp_path / "report.json").read_text(), parse_constant=pytest.fail)
    record = read_record(tmp_path)
    assert {"experiment", "config", "environment", "rows", "claims", "not_judged"} <= set(record)
    assert set(record["environment"]) >= {"versions", "hardware", "seconds"}
    assert set(PACKAGES) < set(record["environment"]["versions"])
    assert Results(record["rows"], record["tags"]) == rows
    assert any(row["test_mse"] is None and row["rho"] is None for row in record["rows"])
    assert all(set(claim) == {"id", "text", "holds", "measured"} for claim in record["claims"])
    assert {claim["holds"] for claim in record["claims"]} <= {True, False, None}
    assert {claim["id"] for claim in record["not_judged"]} == {"C7"}
    assert all(claim["why"] for claim in record["not_judged"])
    assert (record["format"], record["odd"], record["wind_sine_mse"]) == (3, [1.0, None], 1e-3)
    assert record["truth_theta"] == TRUTH
    for extra in (object(), "\ud800"):
        with pytest.raises(ValueError):  # noqa: PT011  two refusals, two messages
            write_report(tmp_path / "new", make_report(make_rows(), extra=extra))
    assert not (tmp_path / "new").exists()


def test_errors_by_altitude_are_means_over_the_windows_of_each_band():
    windows = placeholder(SplitSpec(3, 10))
    windows.x[..., 2] = [[1.0], [1.0], [0.3]]
    windows.x0[:, 2] = 1.0
    windows.x[1, 4, 2] = 0.6  # the lowest state counts
    errors = np.array([[1.0, 3.0, 5.0], [1.0, 3.0, math.inf]])
    found = by_altitude("test_mse", windows, errors)
    np.testing.assert_array_equal(found["test_mse_high"], [2.0, 2.0])
    np.testing.assert_array_equal(found["test_mse_middle"], [5.0, math.inf])
    assert np.isnan(found["test_mse_low"]).all()


@pytest.mark.parametrize(
    ("mean", "std", "text"),
    [(0.0671, 0.0093, "0.067 ± 0.009"), (0.6944, 0.0131, "0.694 ± 0.013"), (22.31, 0.44, "22.3 ± 0.4"),
     (3.21e-4, 2.2e-5, "(3.2 ± 0.2)e-04"), (-0.26, 0.021, "-0.26 ± 0.02"), (0.2, 14.2, "0 ± 14"),
     (2.204, 0.0, "2.2 ± 0"), (2.204, math.nan, "2.2"), (math.inf, 1.0, "inf ± 1")],
)  # fmt: skip
def test_a_mean_ends_with_the_last_digit_that_its_deviation_leaves(mean, std, text):
    assert measured(mean, std) == text


def test_figures_of_failed_runs_too_are_reproducible_and_keep_matplotlibs_settings(tmp_path):
    before, rows = dict(mpl.rcParams), make_rows() + make_rows(domain="external_force")
    rows = changed(rows, "no_physics", "fine_tuned", 500, test_mse=math.inf, status="diverged")
    ranking(rows, "Ranking", {"external_force": 0.01}).savefig(io.BytesIO(), format="png", dpi=30)
    own = rows.where(domain="parameter_shift")
    drawn = {name: (scores(own, "Scores", floor=0.01), "A") for name in ("one", "two")}
    assert save_figures(tmp_path, drawn) == dict.fromkeys(("one.png", "two.png"), "A")
    assert (tmp_path / "one.png").read_bytes() == (tmp_path / "two.png").read_bytes()
    assert dict(mpl.rcParams) == before
