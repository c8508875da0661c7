"""The numbers of the results and the guides are those of the committed reports."""

import json
import re
from functools import cache

import numpy as np
import pytest
from smoke import ROOT

from experiments.online.results import error
from experiments.paper.regret import AUTO, of_each_case, over, regret
from experiments.reporting.names import label
from experiments.reporting.results import Results
from experiments.reporting.tables import measured
from hybrid_jax.identification.learning import UNITS

DOCS, README = ROOT / "docs", ROOT / "README.md"
REFERENCE = DOCS / "reference"
OF_REPORTS = README, *sorted((DOCS / "results").glob("*.md")), DOCS / "notes/public_logs.md"
FROM_COMMANDS = re.compile(r"python -m |hybrid-jax \w+|experiments\.|benchmarks|tests/")
DECIMAL = re.compile(r"(?<![\w.])\d+\.\d+(?!\.?\d)")
NOT_MEASURED = {"2.785", "0.1", "3.11"}  # where RK4 stops being stable; seconds of a window; a version
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
    report = json.loads((REFERENCE / name / "report.json").read_text())
    return Results(report["rows"], report.get("tags", ()))


def lines(page):
    """The lines of all tables of a page, each as its cells without emphasis, by the first cell."""
    rows = [line.split("|")[1:-1] for line in (ROOT / page).read_text().splitlines() if line.startswith("| ")]
    return {first: cells for first, *cells in ([cell.strip(" *") for cell in row] for row in rows)}


def test_seven_changes():
    shown, removed = lines("docs/results/index.md"), []
    for domain, own in committed("changes").group("domain").items():
        rho = 1 - over(own, "source")
        errors = [f"{of_each_case(own, name).mean():.3g}" for name in ("source", "fine_tune", AUTO)]
        names = {"off_centre_load": "a load off centre", "gusty_wind": "slanted, gusty wind"}
        name = names.get(domain, label(domain))
        assert shown[name] == [*errors, f"{rho.mean():.3g}, {rho.min():.3g}"], domain
        removed.append(rho.mean())
    said = f"removes {100 * min(removed):.0f} to {100 * max(removed):.0f} % of"
    assert said in (DOCS / "results/index.md").read_text()
    ratios = regret(committed("changes"))
    assert (f"{np.mean(ratios <= 1.1):.0%}", f"{ratios.max():.2f}") == ("94%", "1.58")


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
        assert float(lines("docs/notes/findings.md")[line][i].strip("✗* ")) == pytest.approx(mean, rel=0.05)


def test_intervals():
    fitted = committed("coverage").where(lambda row: row["inside"] is not None)
    kinds = ("inside", np.mean, 100, ".0f"), ("alone", np.mean, 100, ".0f"), ("half_width", np.median, 1, ".1f")
    for domain in fitted.unique("domain"):
        groups = fitted.where(domain=domain).group("noise", "parameter").values()
        cells = []
        for column, statistic, factor, form in kinds:
            known = [[row[column] for row in own if row[column] is not None] for own in groups]
            values = [factor * statistic(own) for own in known if own]
            cells.append(f"{min(values):{form}} to {max(values):{form}}" if values else "–")
        assert lines("docs/results/intervals.md")[label(domain)] == cells
    alone = np.mean([row["alone"] for row in fitted if row["alone"] is not None])
    assert (len(fitted), f"{np.mean(fitted['inside']):.0%}", f"{alone:.0%}") == (682, "99%", "98%")
    page = (DOCS / "results/intervals.md").read_text()
    assert re.findall(r"(\d+) % of the 95 % intervals.*?(\d+) % of 682", page, flags=re.DOTALL) == [("98", "99")]


@pytest.mark.parametrize(("page", "horizon"), [("results/real_flights", "50"), ("notes/public_logs", "10")])
def test_real_flights(page, horizon):
    for model, shown in zip(REAL, [*lines(f"docs/{page}.md").values()][1:6], strict=True):
        own = committed("real_flight/payload").where(model=model)
        found = [np.sqrt(np.mean(own.numbers(f"scores.{horizon}.{quantity}") ** 2)) for quantity in UNITS]
        assert [*map(float, shown)] == pytest.approx(found, rel=0.02), model


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
                assert float(cell.strip("±* %")) == pytest.approx(width, rel=0.05), (flight, name)


def against_oracle(part):
    """The error of the filter over that of a controller that knows the change, by change and reference."""
    means = {
        case: [np.mean(own.where(agent=agent).numbers(error(part))) for agent in ("online", "oracle")]
        for case, own in committed("online").group("change", "reference").items()
    }
    return {case: online / oracle for case, (online, oracle) in means.items()}


def test_adapting_in_flight():
    settled, first = against_oracle("settled"), [*against_oracle("first_second").values()]
    low, other = ([settled[case] for case in settled if (case[1] == "low_pass") == is_low] for is_low in (True, False))
    *most, worst = sorted(other)
    guide = (DOCS / "howto/online.md").read_text()
    assert f"| {most[0]:.2f} to {most[-1]:.2f}; side wind on the fast figure-8 {worst:.2f} |" in guide
    for few in (low, first):
        assert f"| {min(few):.2f} to {max(few):.2f} |" in guide
    page, rows = (DOCS / "notes/online.md").read_text(), committed("online").where(agent="online")
    low = rows.where(reference="low_pass").group("change")
    shares = [100 * np.mean([[*row["inside"].values()] for row in own]) for own in low.values()]
    assert f"{min(shares):.0f} to {max(shares):.0f} % of the intervals" in page
    alarms = sum(row["alarms"] > 0 for row in low["nothing"])
    assert f"false alarm in {alarms} of {len(low['nothing'])} flights" in page


def decimals(page, linked):
    """The decimals of a page that no report has, by heading, but those of sections that name a command.

    `linked`: the report must be one that the page links.
    """
    text = page.read_text()
    targets = [(page.parent / target).resolve() for target in re.findall(r"\]\(([^)#]*reference/[^)#]*)", text)]
    reports = {target.parent / "report.md" for target in targets} if linked else REFERENCE.rglob("report.md")
    known = {number for path in reports if path.exists() for number in DECIMAL.findall(path.read_text())}
    text = re.sub(r"^```(?!bash|sh|console).*?^```", "", text, flags=re.DOTALL | re.MULTILINE)
    for section in re.split(r"^(?=#{1,3} )", text, flags=re.MULTILINE):
        if not FROM_COMMANDS.search(section):
            prose = re.sub(r"`[^`]*`|\]\([^)]*\)", "", section)
            # Tables of results are looked up line by line above.
            prose = re.sub(r"^\|.*", "", prose, flags=re.MULTILINE) if linked else prose
            yield from set(DECIMAL.findall(prose)) - known


@pytest.mark.parametrize("page", OF_REPORTS, ids=lambda page: page.stem)
def test_results_link_the_report_of_each_number(page):
    assert {*decimals(page, linked=True)} - said() - NOT_MEASURED == set()


@pytest.mark.parametrize("folder", ["howto", "explanation"])
def test_numbers_of_guides_are_in_a_report_or_come_from_a_command(folder):
    found = {number for page in (DOCS / folder).glob("*.md") for number in decimals(page, linked=False)}
    assert found - NOT_MEASURED == set()


@cache
def said():
    """The numbers that results say beside their tables, from rows: each is looked for in its page."""
    online, flown = committed("online"), committed("closed_loop")
    wind = flown.where(domain="external_force", reference="hover", distance=60.0, model="hybrid", n_train=100)
    lost = wind.where(observer=False)["crashed"]
    settled = [*against_oracle("settled").values()]
    changes = online.where(agent="online").group("change").values()
    inside = [np.mean([np.mean([*row["inside"].values()]) for row in own]) for own in changes]
    better = [float(lines("docs/results/control.md")[name][-1]) for name in ("hover", "figure-8, 3.5 m/s", "low pass")]
    fitted = committed("coverage").where(lambda row: row["inside"] is not None)
    wide = {}
    for (domain, *_), own in fitted.group("domain", "noise", "parameter").items():
        needed = np.quantile(np.abs(own.numbers("error")), 0.95)
        wide.setdefault(domain == "gusty_wind", []).append(np.median(own.numbers("half_width")) / needed)
    expected = np.mean(committed("changes").where(lambda row: row["expected_inside"] is not None)["expected_inside"])
    claimed = {
        "control": [
            f"{min(better):.1f} to {max(better):.1f} times", f"{max(settled):.2f} times",
            f"{100 * min(inside):.0f} to {100 * max(inside):.0f} %", f"{sum(lost)} of {len(lost)} hovers",
        ],
        "intervals": [
            *(f"{min(each):.1f} to {max(each):.1f} times as wide" for each in wide.values()),
            f"error on another flight in {100 * expected:.0f} %",
        ],
    }  # fmt: skip
    for page, sentences in claimed.items():
        text = " ".join((DOCS / f"results/{page}.md").read_text().split())
        assert [sentence for sentence in sentences if " ".join(sentence.split()) not in text] == []
    return {number for each in claimed.values() for sentence in each for number in DECIMAL.findall(sentence)}
