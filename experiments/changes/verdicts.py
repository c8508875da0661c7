"""Tables and claims about worlds: never worse than the source, coverage, and other methods."""

from functools import partial

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator

from experiments.changes.measures import EXPECTED as HORIZONS
from experiments.changes.methods import AUTO, NOT_ADAPTED
from experiments.reporting.claims import Claim, Part, Undecided, all_of, every
from experiments.reporting.names import label
from experiments.reporting.plots import METHODS, STYLE, legend_below, name_lines, subplots, tick_errors
from experiments.reporting.results import Results
from experiments.reporting.statistics import Estimate, mean_interval, share_interval
from experiments.reporting.tables import EMPTY, Table, tabulate
from experiments.worlds.world import NOTHING
from hybrid_jax.dynamics.rigid_body import LEARNED

MEAN, EACH = 1.05, 1.2  # times the source's error: in the mean of a case, and of a single adaptation
HELD, EXPECTED = (0.9, 0.99), (0.7, 0.9)  # shares of 95 % and of 80 % intervals that hold
OWN = 0.05  # largest relative error of a source's parameters
CALLED = {AUTO: "hj.adapt", NOT_ADAPTED: "not adapted"}
CASE = "world", "change", "flight"


def _cases(rows: Results) -> dict[tuple, Results]:
    cases = rows.where(method=AUTO).group(*CASE)
    return dict(sorted(cases.items(), key=lambda case: -case[1].numbers("ratio").max()))


def _sound(own: Results) -> bool:
    ratio = own.numbers("ratio")
    return bool(ratio.mean() <= MEAN and ratio.max() <= EACH)


def tables(rows: Results) -> list[Table]:
    return [ratio_table(rows), coverage_table(rows), expectation_table(rows), method_table(rows)]


def ratio_table(rows: Results) -> Table:
    lines = []
    for case, own in _cases(rows).items():
        ratio, taken = own.numbers("ratio"), [row["chosen"] for row in own]
        counts = ", ".join(f"{name} {taken.count(name)}" for name in dict.fromkeys(taken))
        made_for = "yes" if own[0]["made_for"] else "no"
        lines.append((*map(label, case), made_for, f"{ratio.mean():.3g}", f"{ratio.max():.3g}", counts))
    header = ("world", "change", "flight", "candidates made for it", "mean ratio", "worst", "taken")
    return Table("Error over the source's on usual flights, the worst first", header, lines)


def conclusion(rows: Results) -> list[str]:
    cases = _cases(rows)
    worst, own = next(iter(cases.items()))
    return [
        f"In {sum(map(_sound, cases.values()))} of {len(cases)} cases adaptation does no harm: the error is at most "
        f"{MEAN} times the source's in the mean, and at most {EACH} times in a single adaptation.",
        f"The worst case is {label(*worst)}: {own.numbers('ratio').max():.3g} times its error.",
    ]


def known(rows: Results, column: str) -> np.ndarray:
    return np.array([row[column] for row in rows if row[column] is not None], float)


def coverage_table(rows: Results) -> Table:
    """Return a line for each world, method, flight and parameter: coverage of 95 % intervals, error, half-width."""
    lines, rows = [], rows.where(lambda row: row["method"] != NOT_ADAPTED or row["change"] == NOTHING)
    for (world, method, flight), own in rows.group("world", "method", "flight").items():
        for name in LEARNED:
            inside = [known(own, f"{name}{each}_inside") for each in ("", "_kept")]
            shares = (f"{each.mean():.0%} of {len(each)}" if len(each) else EMPTY for each in inside)
            errors, half_widths = (100 * np.abs(known(own, f"{name}_{each}")) for each in ("error", "half_width"))
            effective = int(np.sum(known(own, f"{name}_effective")))
            others = effective, len(errors) - sum(map(len, inside)) - effective
            medians = (f"{np.median(v):.2g}" if len(v) else EMPTY for v in (errors, half_widths))
            names = label(world), CALLED.get(method, method), label(flight), name
            lines.append((*names, *shares, *(f"{count or EMPTY}" for count in others), *medians))
    counts = "contain the truth", "the same, θ_p kept", "effective", "infinite or none"
    header = ("world", "method", "flight", "θ_p", *counts, "median error [%]", "median half-width [%]")
    return Table("Do 95 % intervals of θ_p contain the truth? Not adapted: before any change", header, lines)


def expectation_table(rows: Results) -> Table:
    """Return a line for each world: the share of other flights with an error in the expected interval."""
    columns = {name.split(" ", 1)[1]: lambda own, name=name: f"{known(own, name).mean():.0%}" for name in HORIZONS}
    title = "Do 80 % intervals of the error to expect contain the errors of other flights?"
    return tabulate(title, _expecting(rows), columns, ("world",))


def method_table(rows: Results) -> Table:
    """Return a line for each world, change and method: error, its ratio to the source's, processor time."""
    lines = []
    for own in rows.where(flight="moving", draw=0).group("world", "change").values():
        for key, each in own.group("world", "change", "method").items() if len(own.unique("method")) > 1 else ():
            ratio = each.numbers("ratio")
            numbers = each.numbers("test_mse").mean(), ratio.mean(), ratio.max(), np.median(each.numbers("seconds"))
            world, change, method = key
            names = label(world), label(change), CALLED.get(method, method)
            lines.append((*names, *(f"{number:.3g}" for number in numbers)))
    header = ("world", "change", "method", "test error", "over the source's", "worst", "processor time [s], median")
    return Table("Methods on the same ten seconds", header, lines)


@mpl.rc_context(STYLE)
def draw(rows: Results) -> dict[str, tuple[Figure, str]]:
    """Draw the error over the source's in each case, for each world and draw."""
    worlds, names = rows.unique("world"), [*dict.fromkeys(case[1:] for case in _cases(rows))]
    figure, (panels,) = subplots(max(1.3 + 0.3 * len(names), 2.8), 1, len(worlds), sharey=True, sharex=True)
    for axes, world in zip(panels, worlds, strict=True):
        axes.axvline(1.0, color="0.4", linestyle=":", label="not adapted")
        for (_, *case), own in _cases(rows.where(world=world)).items():
            ratio = own.numbers("ratio")
            y = np.full(len(ratio), names.index(tuple(case)))
            axes.plot(ratio, y, "o", ms=4, alpha=0.7, color=METHODS["adapted"], label="adapted, each flight")
        axes.set(
            xscale="log",
            title=label(str(world)).replace(" (", "\n("),
            xlabel="error / error\nof the source\n(log scale)",
        )
        tick_errors(axes.xaxis, *axes.get_xlim(), room=2.2)
    panels[0].xaxis.set_major_locator(LogLocator(100.0))  # the panels are narrow, and share their axis
    name_lines(panels[0], [label(*case) for case in names])
    caption = "Error of the adapted model over the source's, by the change and the flight that it adapted to"
    title = "Is an adapted model ever worse than its source? (lower is better)"
    return {"ratios": (legend_below(figure, title), caption)}


def _expecting(rows: Results) -> dict[tuple, Results]:
    return rows.where(lambda row: row["method"] == AUTO and row[HORIZONS[0]] is not None).group("world")


def _never_worse(rows: Results) -> Part:
    def of(case: tuple, own: Results) -> Part:
        ratio = own.numbers("ratio")
        return _sound(own), f"{label(*case)} {ratio.mean():.3g}, worst {ratio.max():.3g}"

    return all_of(of(case, own) for case, own in _cases(rows).items())


def _intervals_hold(rows: Results, kept: str = "", limits: tuple[float, float] = HELD) -> Part:
    def of(own: Results) -> tuple[list[bool], list[int]]:
        inside = [(row[f"{name}{kept}_inside"], row["seed"]) for row in own for name in LEARNED]
        told = [(holds, seed) for holds, seed in inside if holds is not None]
        return [holds for holds, _ in told], [seed for _, seed in told]

    groups = {world: of(own) for world, own in rows.where(method=AUTO).group("world").items()}
    if not any(inside for inside, _ in groups.values()):
        raise Undecided("no parameter is called physical")
    return all_of(
        _within(
            share_interval(inside, seeds), limits, f"{label(str(world))}, {len(inside)} of {len(set(seeds))} sources"
        )
        if inside
        else (None, f"{label(str(world))} has none")
        for world, (inside, seeds) in groups.items()
    )


def _within(share: Estimate, limits: tuple[float, float], what: str) -> Part:
    """Whether a share is between two limits; undecided if one of these is in its confidence interval."""
    ends = "" if np.isnan(share.low) else f" ({share.low:.1%} to {share.high:.1%})"
    return every([share.above(limits[0]), share.below(limits[1])]), f"{what}: {share.value:.1%}{ends}"


def _expects_its_errors(rows: Results) -> Part:
    def of(world: str, own: Results, name: str) -> Part:
        share = mean_interval(own[name], own["seed"])
        return _within(share, EXPECTED, f"{label(world)} after {name.split(' ', 1)[1]}")

    if not (groups := _expecting(rows)):
        raise Undecided("no errors were expected")
    return all_of(of(str(world), own, name) for world, own in groups.items() for name in HORIZONS)


def _sources_are_physical(rows: Results) -> Part:
    def of(world: str, own: Results) -> Part:
        worst = {name: float(np.abs(known(own, f"{name}_error")).max()) for name in LEARNED}
        found = ", ".join(f"{name} {error:.1%}" for name, error in worst.items())
        return max(worst.values()) <= OWN, f"{label(world)}, {len(own)} sources: at most {found}"

    if not (groups := rows.where(method=NOT_ADAPTED, change=NOTHING).group("world")):
        raise Undecided("no source's parameters are known")
    return all_of(of(str(world), own) for world, own in groups.items())


CLAIMS = (
    Claim("W1", f"In every case the error of the adapted model is at most {MEAN} times its source's in the mean, and "
          f"at most {EACH} times in each adaptation.", _never_worse),
    Claim("W2", f"In each world {HELD[0]:.0%} to {HELD[1]:.0%} of the 95 % intervals of fitted Ix, Iy and k "
          "contain the truth, where these are called physical (undecided if a limit is in the share's 95 % interval "
          "over sources).",
          _intervals_hold),
    Claim("W3", f"In each world the 80 % intervals of the errors to expect contain the errors of other flights in "
          f"{EXPECTED[0]:.0%} to {EXPECTED[1]:.0%} of cases, after 0.1 s and after 1 s (undecided as W2).",
          _expects_its_errors),
    Claim("W4", f"In each world Ix, Iy and k of every source are within {OWN:.0%} of the vehicle's.",
          _sources_are_physical),
    Claim("W5", f"In each world at least {HELD[0]:.0%} of the 95 % intervals of Ix, Iy and k contain the truth, where "
          "these keep the source's value (undecided as W2).",
          partial(_intervals_hold, kept="_kept", limits=(HELD[0], np.inf))),
)  # fmt: skip
