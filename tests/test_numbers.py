"""The numbers of the results and the guides are those of the committed reports."""

import inspect
import json
from functools import cache

import numpy as np
import pytest
from smoke import ROOT

import hybrid_jax as hj
from experiments.paper.regret import AUTO, of_each_case, over
from experiments.reporting.names import label
from experiments.reporting.report import read_record, rows_in
from experiments.reporting.tables import measured
from hybrid_jax.identification.learning import UNITS

DOCS = ROOT / "docs"
REFERENCE = DOCS / "reference"
PAPER = {"inertia": "param_shift", "wind": "external_force"}
METHODS = (("hybrid", "fine_tuned"), ("hybrid", "target_only"), ("no_physics", "fine_tuned"))
METHODS += (("constant_disturbance", "fine_tuned"),)
REAL = "adapted", "scratch", "linear_residual", "hold", "thrust"  # the lines of the tables of real flights
# Of the table of ten methods: the report of each column, and the model of each line.
PROTOCOLS = ("random-1000-noise0", "contiguous-own-noise1")
COMPARED = {
    "source, not adapted": ("hybrid", "source_only"), "hybrid": ("hybrid", "fine_tuned"),
    "no-physics": ("no_physics", "fine_tuned"), "physics-only": ("physics_only", "fine_tuned"),
    "last layer (ridge)": ("last_layer", "fine_tuned"), "source + linear residual": ("linear_residual", "fine_tuned"),
    "hj.adapt (θ_p + disturbance)": ("constant_disturbance", "fine_tuned"),
}  # fmt: skip


@cache
def committed(name):
    """The rows of a report in docs/reference."""
    return rows_in(read_record(REFERENCE / name))


def lines(page):
    """The lines of all tables of a page, each as its cells without emphasis, by the first cell."""
    rows = [line.split("|")[1:-1] for line in (ROOT / page).read_text().splitlines() if line.startswith("| ")]
    return {first: cells for first, *cells in ([cell.strip(" *") for cell in row] for row in rows)}


def same(shown, number):
    """Whether a number is shown as it is, to its last digit."""
    return shown == f"{number:.{len(shown.partition('.')[2])}f}"


def test_seven_changes():
    shown = lines("docs/results/index.md")
    for domain, both in committed("changes").group("domain").items():
        expected = []
        for own in both.group("world").values():
            rho = 1 - over(own, "source")
            errors = [f"{of_each_case(own, name).mean():.3g}" for name in ("source", "fine_tune", AUTO)]
            expected += [*errors, f"{rho.mean():.3g}, {rho.min():.3g}"]
        names = {"off_centre_load": "a load off centre", "gusty_wind": "slanted, gusty wind"}
        assert shown[names.get(domain, label(domain))] == expected, domain


@pytest.mark.parametrize("change", PAPER)
@pytest.mark.parametrize("n", [100, 1000])
def test_the_paper(change, n):
    rows = committed(PAPER[change])
    found = [rows.where(model=model, mode=mode, n_train=n).spread("test_mse") for model, mode in METHODS]
    assert lines("docs/results/paper.md")[f"{change}, {n}"] == [measured(each.mean, each.std) for each in found]


def test_the_verdicts():
    shown = {name.split()[0]: verdicts for name, verdicts in lines("docs/results/paper.md").items()}
    words = {True: "yes", False: "no", None: "undecided"}
    for column, name in enumerate(PAPER.values()):
        report = json.loads((ROOT / "docs/reference" / name / "report.json").read_text())
        for claim in report["claims"]:
            assert shown[claim["id"]][column] == words[claim["holds"]], (name, claim["id"])


@pytest.mark.parametrize("line", COMPARED)
def test_ten_methods(line):
    model, mode = COMPARED[line]
    for i, (domain, name) in enumerate((d, p) for d in ("parameter_shift", "external_force") for p in PROTOCOLS):
        rows = committed("comparison" if name == PROTOCOLS[0] else f"comparison/{name}").where(domain=domain)
        mean = 1000 * rows.where(model=model, mode=mode).spread("test_mse").mean
        assert same(lines("docs/notes/findings.md")[line][i].strip("✗* "), mean)


def fitted_of_coverage():
    return committed("coverage").where(lambda row: row["inside"] is not None)


def test_intervals():
    fitted, shown = fitted_of_coverage(), lines("docs/results/intervals.md")
    kinds = ("inside", np.mean, 100, ".0f"), ("alone", np.mean, 100, ".0f"), ("half_width", np.median, 1, ".1f")
    for (world, domain), each in fitted.group("world", "domain").items():
        groups = each.group("noise", "parameter").values()
        cells = []
        for column, statistic, factor, form in kinds:
            known = [[row[column] for row in own if row[column] is not None] for own in groups]
            values = [factor * statistic(own) for own in known if own]
            cells.append(f"{min(values):{form}} to {max(values):{form}}" if values else "–")
        assert shown["Hummingbird, " * (world == "hummingbird") + label(domain)] == cells


@pytest.mark.parametrize(("page", "horizon"), [("results/real_flights", "50"), ("notes/public_logs", "10")])
def test_real_flights(page, horizon):
    for model, shown in zip(REAL, [*lines(f"docs/{page}.md").values()][1:6], strict=True):
        own = committed("real_flight/payload").where(model=model)
        found = [np.sqrt(np.mean(own.numbers(f"scores.{horizon}.{quantity}") ** 2)) for quantity in UNITS]
        assert all(map(same, shown, found)), (model, found)


def test_flying():
    rows = committed("closed_loop").where(domain="external_force", observer=False, distance=0.0)
    for line, reference in {"hover": "hover", "figure-8, 3.5 m/s": "figure_eight", "low pass": "low_pass"}.items():
        models = {"model": "invariant", "n_train": 0}, {"model": "least_squares", "n_train": 100}
        before, after = (rows.where(reference=reference, **own).spread("position_rmse").mean for own in models)
        expected = [f"{100 * before:.2f} cm", f"{100 * after:.2f} cm", f"{before / after:.2f}"]
        assert lines("docs/results/control.md")[line] == expected


def test_the_most_informative_flight():
    shown = lines("docs/howto/excitation.md")
    names = {"figure-8": "figure-8 at 3.5 m/s", "random": "random, as in the paper"}
    for flight, own in committed("excitation").group("flight").items():
        for name, cell in zip(("Ix", "Iy", "k"), shown[names.get(flight, flight)], strict=True):
            width = own.where(parameter=name).spread("half_width").mean
            if cell == "no bound":
                assert width > 100
            else:
                assert same(cell.strip("±* %"), width), (flight, name)


def test_the_defaults_of_fit():
    shown, options = lines("docs/howto/train.md"), inspect.signature(hj.fit).parameters
    for name in ("min_epochs", "patience", "max_epochs"):
        assert shown[f"`{name}`"][-1] == str(options[name].default)
