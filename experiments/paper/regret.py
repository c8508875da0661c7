"""The error of `auto` against the best candidate in hindsight."""

from collections.abc import Callable, Mapping, Sequence

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from experiments.reporting import names
from experiments.reporting.claims import Claim, Part, Undecided, all_of
from experiments.reporting.plots import METHODS, STYLE, legend_below, name_lines, note, subplots, tick_errors
from experiments.reporting.results import Results
from experiments.reporting.tables import Table

NEAR = 1.1  # times the error of the best candidate
SHARE = 0.9  # of the cases that must be near it
WORSE = 1.02  # times the source's error
MEAN_RHO, WORST_RHO = 0.93, 0.85
HELD = 0.7, 0.9  # share of errors in their 80 % interval
AUTO = "auto"  # the candidate that was taken
COMPARED = "fine_tune", "fine_tune_offset", "l2_sp"  # no candidates
TAGS = "world", "domain", "candidate", "draw", "seed"
CASE = "world", "domain", "draw", "seed"
ERRORS = "test_mse", "position_mse"  # columns: of all states, and of the position [m²]
SHOWN = {  # method → label, colour, marker; side and alignment of its number
    "source": ("not adapted", METHODS["not adapted"], "s", 1, "left"),
    "fine_tune": ("fine-tuned (Adam)", METHODS["fine-tuned"], "^", -1, "center"),
    AUTO: ("hj.adapt", METHODS["adapted"], "o", 1, "right"),
}


def of_each_case(rows: Results, name: str, column: str = ERRORS[0]) -> np.ndarray:
    own = rows.where(taken=True) if name == AUTO else rows.where(candidate=name)
    return np.array([case.numbers(column)[0] for case in own.group(*CASE).values()])


def best_of_each_case(rows: Results) -> np.ndarray:
    candidates = rows.where(lambda row: row["candidate"] not in COMPARED)
    return np.array([case.spread("test_mse").smallest for case in candidates.group(*CASE).values()])


def regret(rows: Results) -> np.ndarray:
    return of_each_case(rows, AUTO) / best_of_each_case(rows)


def over(rows: Results, name: str) -> np.ndarray:
    """Return the chosen candidate's error over another's, or a method's, in each case."""
    return of_each_case(rows, AUTO) / of_each_case(rows, name)


def _near_the_best(rows: Results) -> Part:
    found = regret(rows)
    share = float(np.mean(found <= NEAR))
    return share >= SHARE, f"{share:.1%} of {len(found)} cases, the largest regret is {found.max():.3g}"


def _never_worse(rows: Results) -> Part:
    worst = float(over(rows, "source").max())
    return worst <= WORSE, f"at worst {worst:.3g} times the source's error"


def _gains(rows: Results) -> Part:
    sound, words = [], []
    for domain, own in rows.where(domain=(names.PARAMETER_SHIFT, names.EXTERNAL_FORCE)).group("domain").items():
        rho = 1 - over(own, "source")
        sound.append(rho.mean() >= MEAN_RHO and rho.min() >= WORST_RHO)
        words.append(f"{names.label(domain)}: mean {rho.mean():.3f}, worst {rho.min():.3f}")
    if not sound:
        raise Undecided("neither was flown")
    return all(sound), "; ".join(words)


def _beats_fine_tuning(rows: Results) -> Part:
    if "fine_tune" not in rows.unique("candidate"):
        raise Undecided("there was no fine-tuning to compare with")
    ratio = over(rows, "fine_tune")
    return bool((ratio < 1).all()), f"at worst {ratio.max():.3g} times its error, {np.mean(ratio < 1):.0%} below it"


def _expects_its_error(rows: Results) -> Part:
    own = rows.where(lambda row: row["expected_inside"] is not None)
    if not len(own):
        raise Undecided("there is no other flight to compare with")
    shares = {domain: float(np.mean(group["expected_inside"])) for domain, group in own.group("domain").items()}
    share = float(np.mean([*shares.values()]))
    words = ", ".join(f"{names.label(domain)} {value:.0%}" for domain, value in shares.items())
    return HELD[0] <= share <= HELD[1], f"{share:.1%} in the mean over changes ({words})"


def _in_each_world(part: Callable[[Results], Part]) -> Callable[[Results], Part]:
    def of(rows: Results) -> Part:
        found = {names.label(world): part(own) for world, own in rows.group("world").items()}
        return all_of((holds, f"{world}: {words}") for world, (holds, words) in found.items())

    return of


CLAIMS: Sequence[Claim[Results]] = (
    Claim("A1", f"The error of the candidate that is taken is at most {NEAR - 1:.0%} above the least one "
          f"in {SHARE:.0%} of all cases.", _in_each_world(_near_the_best)),
    Claim("A2", f"Its error is never more than {WORSE - 1:.0%} above the source's.", _in_each_world(_never_worse)),
    Claim("A3", f"In both experiments of the paper its mean ρ is at least {MEAN_RHO} and its worst at least "
          f"{WORST_RHO}.", _in_each_world(_gains)),
    Claim("A4", "Its error is smaller than after fine-tuning by Adam in every case.",
          _in_each_world(_beats_fine_tuning)),
    Claim("A5", f"The 80 % intervals of its RMSE contain the RMSE of another flight in {HELD[0]:.0%} to "
          f"{HELD[1]:.0%} of cases.", _in_each_world(_expects_its_error)),
)  # fmt: skip


def conclusion(rows: Results) -> list[str]:
    gains, more = [], []
    for world, own in rows.group("world").items():
        groups = own.group("domain").values()
        rho = [1 - over(each, "source").mean() for each in groups]
        gains.append(f"{min(rho):.0%} to {max(rho):.0%} in the {names.label(world)}")
        if "fine_tune" in own.unique("candidate"):
            tuned, source = ([of_each_case(e, name).mean() for e in groups] for name in ("fine_tune", "source"))
            more.append(f"{np.sum(np.greater(tuned, source))}")
    words = f"Of the source's mean squared error `hj.adapt` removes, by change, {' and '.join(gains)}"
    harm = f"; fine-tuning increases it in {' and '.join(more)} of {len(rows.unique('domain'))} changes"
    return [f"{words}{harm if more else ''}."]


def regret_table(rows: Results) -> Table:
    lines = []
    for case, own in rows.group("world", "domain").items():
        found, rho = regret(own), 1 - over(own, "source")
        counts = {name: len(each) for name, each in own.where(taken=True).group("candidate").items()}
        taken = ", ".join(f"{name} {n}" for name, n in sorted(counts.items(), key=lambda item: -item[1]))
        numbers = np.mean(found <= NEAR), np.median(found), found.max(), rho.mean(), rho.min()
        texts = (f"{number:{form}}" for number, form in zip(numbers, (".0%", ".3f", ".3f", ".3f", ".3f"), strict=True))
        lines.append((*map(names.label, case), *texts, taken))
    header = ("world", "change", f"regret ≤ {NEAR}", "median", "largest", "mean ρ", "worst ρ", "taken, number of cases")
    title = "Error over the best candidate's (regret), and the share ρ of the source's error that is removed"
    return Table(title, header, lines)


def error_tables(rows: Results) -> list[Table]:
    return [_error_table(names.label(world), own) for world, own in rows.group("world").items()]


def _error_table(world: str, rows: Results) -> Table:
    groups = rows.group("domain")
    methods, own = (AUTO, *rows.unique("candidate")), groups.values()
    lines = [(name, *(f"{of_each_case(each, name).mean():.3g}" for each in own)) for name in methods]
    return Table(f"Mean test error, {world} (less is better)", ("method", *map(names.label, groups)), lines)


@mpl.rc_context(STYLE)
def error_figure(rows: Results) -> Figure:
    """Draw each change's error of the position [m] in each world; lines reach from the least to the most."""
    worlds, changes = rows.group("world"), rows.unique("domain")
    figure, (panels,) = subplots(1.6 + 0.4 * len(changes), 1, len(worlds), sharey=True)
    for axes, (world, own) in zip(panels, worlds.items(), strict=True):
        _draw_errors(axes, own.group("domain"))
        axes.set(xscale="log", title=names.label(world))
        axes.set_xlabel("RMS position error\nover 1 s [m] (log scale)")
        axes.margins(x=0.12)
        tick_errors(axes.xaxis, *axes.get_xlim(), room=1.2)
    name_lines(panels[0], [*map(names.label, changes)])
    return legend_below(figure, "After a change: ten seconds of one noisy flight (band: all cases; lower is better)")


def _draw_errors(axes: Axes, groups: Mapping[str, Results]) -> None:
    for y, own in enumerate(groups.values()):
        for name, (label, colour, marker, side, ha) in SHOWN.items():
            if name in (AUTO, *own.unique("candidate")):
                errors = of_each_case(own, name, ERRORS[1])
                each, mean = np.sqrt(errors), np.sqrt(errors.mean())
                axes.plot([each.min(), each.max()], [y, y], color=colour, lw=4, alpha=0.25, solid_capstyle="round")
                axes.plot(mean, y, marker, ms=6, color=colour, ls="", label="" if y else label)
                style = {"va": "bottom" if side > 0 else "top", "color": colour}
                if np.isfinite(mean):
                    note(axes, f"{mean:.2g}", (mean, y), (0, 5 * side), ha=ha, **style)
                else:
                    words = f"{np.sum(~np.isfinite(each))} of {len(each)} diverge"
                    note(axes, words, (1, y), (0, 5 * side), xycoords=axes.get_yaxis_transform(), ha="right", **style)
