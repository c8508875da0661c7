"""Every number in a sentence of a page is one of a committed report, or of the code."""

import json
import re

import numpy as np
import pytest
from smoke import ROOT
from test_numbers import DOCS, PAPER, REFERENCE, committed, fitted_of_coverage, lines

import hybrid_jax as hj
from experiments.changes.verdicts import EACH, MEAN
from experiments.online.results import error
from experiments.paper.outcome import FLOOR
from experiments.paper.regret import AUTO, ERRORS, NEAR, of_each_case, over, regret
from experiments.reporting.tables import measured
from hybrid_jax import trajectories
from hybrid_jax.cli import export
from hybrid_jax.control import Controller
from hybrid_jax.dynamics import grids
from hybrid_jax.estimation.discretisation import COARSE
from hybrid_jax.flights import conversion
from hybrid_jax.flights.checks import airborne
from hybrid_jax.identification import estimates, slow_commands
from hybrid_jax.online import tuning
from hybrid_jax.sim import PARAMETER_SHIFT
from hybrid_jax.vehicle import SENSOR_NOISE

PAGES = [ROOT / "README.md", DOCS / "notes/online.md"]
PAGES += sorted(path for name in ("results", "howto", "explanation") for path in (DOCS / name).glob("*.md"))
MEASURED = re.compile(r"(?<![\w.,/-])\d+\.\d+(?!\.?\d)|(?<![\w.,-])\d+(?= ?(?:%|times\b|of \d|[mµ]s\b|minutes\b))")
# What no run has found: confidence levels, the length of windows and of predictions, versions, units, examples.
DEFINED = re.compile(
    r"\b(95|80) %|windows of 0\.1 s|[Aa]fter 0\.[15] s|Python 3\.11|Betaflight\*\* 4\.3|2π/60 times|\*100 % is the"
    r"|change by 0\.3|is 30 ms old|are 50 ms late|With 50 instead of 0\.05"
)
KINDS = "alone", "inside"  # of one source, and pooled


def against_oracle(part, world="iris"):
    """The error of the filter over that of a controller that knows the change, by change and reference."""
    means = {
        case: [np.mean(own.where(agent=agent).numbers(error(part))) for agent in ("online", "oracle")]
        for case, own in committed("online").where(world=world).group("change", "reference").items()
    }
    return {case: online / oracle for case, (online, oracle) in means.items()}


TUNED, WORDS = ("fine_tune", "source"), {0: "none", 1: "one", 4: "four", 6: "six"}


def of_changes():
    ours, theirs = committed("changes").group("world").values()
    yield "results/index", f"at most {NEAR} times the error of the best candidate"
    for rows, removed, best in (
        (ours, "removes {} of the error", "In {} of the cases the error of the candidate that ` chooses is"),
        (theirs, "that others wrote, {}", "(Hummingbird: {};"),
    ):
        groups, ratios = rows.group("domain").values(), regret(rows)
        rho = [100 * np.mean(1 - over(own, "source")) for own in groups]
        yield "results/index", removed.format(f"{min(rho):.0f} to {max(rho):.0f} %")
        yield "results/index", best.format(f"{100 * np.mean(ratios <= NEAR):.0f} %")
        yield "results/index", f"{ratios.max():.2f} times"
        mean = {way: [[of_each_case(own, way, e).mean() for own in groups] for e in ERRORS] for way in (*TUNED, AUTO)}
        yield "results/index", f"{WORDS[np.sum(np.greater(*(mean[way][0] for way in TUNED)))]} of the seven"
        for way, words in (TUNED[1], "m without adaptation,"), (AUTO, "m with"):
            yield "results/index", f"{min(mean[way][1]) ** 0.5:.2f} to {max(mean[way][1]) ** 0.5:.2f} {words}"
    inside = np.mean([row["expected_inside"] for row in committed("changes") if row["expected_inside"] is not None])
    yield "results/intervals", f"contain the error on another flight in {100 * inside:.0f} % of the cases"


def of_the_paper():
    before = [committed(name).where(mode="source_only", model="hybrid").spread("test_mse") for name in PAPER.values()]
    shift, wind = (measured(each.mean, each.std) for each in before)
    yield "results/paper", f"Without adaptation it is {shift} (inertia) and {wind} (wind)"
    sine = json.loads((REFERENCE / "external_force/report.json").read_text())[FLOOR]
    yield "results/paper", f"In the wind, {sine:.3g} of the error"
    less, more = 100 * (np.divide(hj.IRIS.inertia, PARAMETER_SHIFT.vehicle.inertia)[:2] - 1)
    yield "howto/excitation", f"inertia, {-less:.0f} % below the true one about x and {more:.0f} % above it about y"


def of_flying():
    better = [float(lines("docs/results/control.md")[name][-1]) for name in ("hover", "figure-8, 3.5 m/s", "low pass")]
    yield "results/control", f"the position error is {min(better):.1f} to {max(better):.1f} times smaller"
    flown = committed("closed_loop").where(domain="parameter_shift", model="least_squares", observer=False)
    excess = max(np.mean(own.numbers("excess")) for own in flown.where(distance=0.0).group("reference").values())
    yield "results/control", f"cost what they predict within {100 * excess:.0f} %"
    flown = committed("closed_loop").where(domain="external_force", reference="hover", distance=60.0, observer=False)
    lost = flown.where(model="hybrid", n_train=100)["crashed"]
    for page, text in ("results/control", "in the wind, it"), ("explanation/failures", "60 m away from its data it"):
        yield page, f"{text} crashed in {sum(lost)} of {len(lost)} hovers"
    real = [committed("real_flight/nanodrone").where(model=model) for model in ("learned", "thrust")]
    learned, frozen = (np.mean(own.numbers("scores.50.velocity") ** 2) for own in real)
    yield "results/real_flights", f"is {np.sqrt(learned / frozen):.2f} times as large as with frozen body rates"


def of_adapting_in_flight():
    settled, first = against_oracle("settled"), [*against_oracle("first_second").values()]
    low, other = ([settled[case] for case in settled if (case[1] == "low_pass") == is_low] for is_low in (True, False))
    *most, worst = sorted(other)
    for page in ("results/control", "explanation/failures"):
        yield page, f"error is at most {max(settled.values()):.2f} times as large as with a controller that knows"
    yield "explanation/failures", f"the error is up to {max(low):.2f} times as large"
    yield "notes/online", f"it is {most[0]:.2f} to {most[-1]:.2f} times the oracle's, and {worst:.2f} times in a"
    yield "notes/online", f"it is {min(low):.2f} to {max(low):.2f} times the oracle's"
    yield "notes/online", f"the error is {min(first):.1f} to {max(first):.1f} times the oracle's"
    theirs = against_oracle("settled", "hummingbird")
    still, moving = ([theirs[case] for case in theirs if (case[1] == "hover") == own] for own in (True, False))
    yield "results/control", f"hover the error is at most {max(still):.2f} times"
    yield "results/control", f"references {min(moving):.2f} to {max(moving):.2f} times. A"
    both = committed("online").where(world="hummingbird").group("change", "reference").values()
    means = [[np.mean(own.where(agent=a).numbers(error("settled"))) for a in ("observer", "online")] for own in both]
    yield "results/control", f"observer flies closer in {sum(a < b for a, b in means)} of {len(means)} cases"
    rows = committed("online").where(agent="online", world="iris")
    inside = [100 * np.mean([[*row["inside"].values()] for row in own]) for own in rows.group("change").values()]
    yield "results/control", f"{min(inside):.0f} to {max(inside):.0f} % of its 95 % intervals contain the true value"
    low = rows.where(reference="low_pass").group("change")
    shares = [100 * np.mean([[*row["inside"].values()] for row in own]) for own in low.values()]
    yield "notes/online", f"{min(shares):.0f} to {max(shares):.0f} % of the intervals"
    alarmed = [row["alarms"] > 0 for row in low["nothing"]]
    yield "notes/online", f"false alarm in {sum(alarmed)} of {len(alarmed)} flights"


def of_intervals():
    for world, text in (
        ("hummingbird", "Hummingbird it is {} %, and {} % of {} pooled intervals"),
        ("iris", "{} % of the 95 % intervals contain the true value, and {} % of {} intervals that are pooled"),
    ):
        fitted = fitted_of_coverage().where(world=world)
        numbers = [f"{100 * np.mean([row[kind] for row in fitted if row[kind] is not None]):.0f}" for kind in KINDS]
        yield "results/intervals", text.format(*numbers, len(fitted))
    wide = {}
    for (world, domain, *_), own in fitted_of_coverage().group("world", "domain", "noise", "parameter").items():
        needed = np.quantile(np.abs(own.numbers("error")), 0.95)
        wide.setdefault((world, domain == "gusty_wind"), []).append(np.median(own.numbers("half_width")) / needed)
    steady, gusty, steady_abroad, gusty_abroad = (f"{min(each):.1f} to {max(each):.1f} times" for each in wide.values())
    yield "results/intervals", f"Iris' pooled intervals are {steady} as wide as needed, and {gusty} in gusts"
    yield "results/intervals", f"The Hummingbird's are {steady_abroad} as wide, and {gusty_abroad} in gusts"
    abroad = fitted_of_coverage().where(world="hummingbird")
    worst = min(abroad.group("domain", "noise", "parameter").values(), key=lambda own: np.mean(own["inside"]))
    name, least = worst[0]["parameter"], 100 * np.mean(worst["inside"])
    yield "results/intervals", f"{least:.0f} % are those of the Hummingbird's {name} in"
    yield "results/intervals", f"it is {-np.mean(worst.numbers('error')):.1f} % too small in the mean"
    gusts = abroad.where(domain="gusty_wind", parameter="k").group("noise").values()
    gusts = [np.mean(own.numbers("error")) for own in gusts]
    small = f"up to {-min(gusts):.0f} % too small in the mean"
    yield "results/intervals", f"k is {small}"
    high = lines("docs/results/intervals.md")["Hummingbird, gusty wind"][1]
    yield "explanation/failures", f"{small}, and 95 % intervals of one source contain the true value in {high} % of"
    claims = json.loads((REFERENCE / "changes/harm/report.json").read_text())["claims"]
    harm, *said, sources, kept = (claim["measured"] for claim in claims)
    harms = [[*map(float, re.findall(r"([\d.]+), worst ([\d.]+)$", case)[0])] for case in harm.split("; ")]
    sound = [mean <= MEAN and worst <= EACH for mean, worst in harms]
    yield "explanation/failures", f"no harm in {sum(sound)} of {len(sound)} cases"
    highest = max(worst for _, worst in harms)
    yield "explanation/failures", f"at most {highest:g} times the source's in any single flight"
    shares = re.findall(r"(\d+) of \d+ sources: ([\d.]+)%", said[0])
    texts = "intervals of an Iris contained", "of the Hummingbird", "of a Crazyflie"
    for text, (cases, share) in zip(texts, shares, strict=True):
        yield "results/intervals", f"{share} % of {cases} {text}"
    shares = sorted(re.findall(r": ([\d.]+)%", said[1]), key=float)
    for page in ("results/intervals", "explanation/uncertainty"):
        yield page, f"contained the errors in {shares[0]} to {shares[-1]} % of the cases"
    worst = max(re.findall(r" ([\d.]+)%", sources), key=float)
    yield "results/intervals", f"at most {worst} % from the vehicles'"
    cases, shares = zip(*re.findall(r"(\d+) of \d+ sources: ([\d.]+)%", kept), strict=True)
    yield "results/intervals", f"{min(map(float, shares)):.0f} % of {sum(map(int, cases))} intervals of kept parameters"
    hover = committed("changes/harm").where(flight="hover", method="auto")
    infinite = [row[f"{name}_kept_inside"] is None for row in hover for name in ("Ix", "Iy")]
    yield "results/intervals", f"after a hover {sum(infinite)} of {len(infinite)} of Ix and Iy were infinite"
    page = (REFERENCE / "changes/harm/report.md").read_text()
    other = dict(re.findall(r"^\| Humm.*? hj.adapt \| usual flight \| (\w+) .* \| (\S+ \| \S+) \|$", page, re.M))
    errors, widths = zip(*(other[name].split(" | ") for name in ("Ix", "Iy", "k")), strict=True)
    yield "results/intervals", "±{} % (Ix), ±{} % (Iy) and ±{} % (k) wide".format(*widths)
    yield "results/intervals", "with errors of only {}, {} and {} %".format(*errors)


def of_settings():
    """Defaults and limits of the code that guides name."""
    noise, (*most, last) = ([f"{each:g}" for each in sizes] for sizes in (SENSOR_NOISE, export.PROCESS))
    own = Controller(hj.IRIS)
    low, high = (100 * each for each in trajectories.RANGE)
    yield "howto/c", f"The default is {' '.join(noise)}, for motion capture"
    yield "howto/c", f"process noise of {', '.join(most)} and {last} 1/√s"
    yield "howto/excitation", "1 mm, {1} of each entry of the quaternion, {2} m/s, {3} rad/s".format(*noise)
    yield "howto/control", f"At each call, every {own.period:g} s"
    yield "howto/control", f"{own.steps} intervals of {own.interval:g} s"
    yield "howto/identify", f"A flight begins {airborne.CLEAR:g} m above"
    yield "howto/identify", f"less often than every {slow_commands.SLOW:g} s"
    yield "howto/logs", f"{conversion.DT:g} s by default"
    yield "howto/online", f"more than {tuning.SLOWEST:g} s apart"
    yield "howto/pde", f"steps of up to {grids.REAL_AXIS:g} spacing²"
    yield "howto/records", f"If this is above {COARSE:g}, a warning"
    yield "howto/tool", f"a mass of {estimates.MASS:g} kg and arms of {estimates.ARM:g} m"
    yield "explanation/failures", f"outside the {low:g} to {high:g} % range of the training data."
    yield "explanation/failures", f"Above {100 * trajectories.WARN:g} % you should not trust"


CLAIMS = of_changes, of_the_paper, of_flying, of_adapting_in_flight, of_intervals, of_settings


@pytest.mark.parametrize("place", PAGES, ids=lambda path: path.stem)
def test_every_number_of_a_page_is_a_result_or_a_setting(place):
    """Tables of results are compared line by line in test_numbers.py, and the README's in test_readme.py."""
    text = re.sub(r"^```.*?^```|^\|.*?$|^ {4}\S.*?$|\$\$.*?\$\$", "", place.read_text(), flags=re.DOTALL | re.MULTILINE)
    text = " ".join(re.sub(r"`[^`]*`|\]\([^)]*\)|\$[^$]*\$", "`", text).split())
    for name, sentence in (claim for claims in CLAIMS for claim in claims()):
        if f"{place.parent.name}/{place.stem}" == name:
            assert sentence in text
            text = text.replace(sentence, "")
    if place.parent.name != "notes":
        assert MEASURED.findall(DEFINED.sub("", text)) == []
