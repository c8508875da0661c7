"""What the rows of worlds say: never worse than the source, intervals that hold, and what other methods do."""

import numpy as np

from experiments.reporting.claims import Claim, Part, Undecided, all_of
from experiments.reporting.results import Results
from experiments.reporting.tables import EMPTY, Table, tabulate
from experiments.worlds.methods import AUTO
from hybrid_jax.dynamics.rigid_body import LEARNED

MEAN, EACH = 1.05, 1.2  # times the source's error: in the mean of a case, and of a single adaptation
HELD, EXPECTED = (0.9, 0.99), (0.7, 0.9)  # shares of 95 % and of 80 % intervals that hold
CASE = "world", "change", "flight"


def ratio_table(rows: Results) -> Table:
    """A line for each case, the worst first."""
    cases = sorted(_cases(rows).items(), key=lambda case: -case[1].numbers("ratio").max())
    lines = []
    for case, own in cases:
        ratio, taken = own.numbers("ratio"), [row["chosen"] for row in own]
        counts = ", ".join(f"{name} {taken.count(name)}" for name in dict.fromkeys(taken))
        made_for = "yes" if own[0]["made_for"] else "no"
        lines.append((*case, made_for, f"{ratio.mean():.3g}", f"{ratio.max():.3g}", counts))
    header = ("world", "change", "flight", "candidates made for it", "mean ratio", "worst", "taken")
    return Table("Error over the source's on usual flights, the worst first", header, lines)


def conclusion(rows: Results) -> list[str]:
    """How often the law holds, and where it fails most."""
    cases = _cases(rows)
    sound = [_is_sound(own) for own in cases.values()]
    (worst, own) = max(cases.items(), key=lambda case: case[1].numbers("ratio").max())
    return [
        f"In {sum(sound)} of {len(sound)} cases the adapted model is never worse than its source: at most {MEAN} times "
        f"its error in the mean, {EACH} times in a single adaptation.",
        f"The worst is {' '.join(map(str, worst))} (world, change, flight): {own.numbers('ratio').max():.3g} times.",
    ]


def _is_sound(own: Results) -> bool:
    ratio = own.numbers("ratio")
    return bool(ratio.mean() <= MEAN and ratio.max() <= EACH)


def _never_worse(rows: Results) -> Part:
    def of(case: tuple, own: Results) -> Part:
        ratio = own.numbers("ratio")
        return _is_sound(own), f"{' '.join(map(str, case))} {ratio.mean():.3g}, worst {ratio.max():.3g}"

    return all_of(of(case, own) for case, own in _cases(rows).items())


def coverage_table(rows: Results) -> Table:
    """A line for each world, method and parameter: how many 95 % intervals hold the truth, error, half-width."""
    lines = []
    for (world, method), own in rows.where(flight="moving").group("world", "method").items():
        for name in LEARNED:
            known = own.where(lambda row, name=name: row[f"{name}_error"] is not None)
            inside = _inside(known, name)
            share = f"{np.mean(inside):.0%} of {len(inside)}" if inside else EMPTY
            half = [row[f"{name}_half_width"] for row in known if row[f"{name}_half_width"] is not None]
            width = f"{100 * np.median(half):.2g}" if half else EMPTY
            away = f"{100 * np.median(np.abs(known.numbers(f'{name}_error'))):.2g}" if len(known) else EMPTY
            lines.append((world, method, name, share, away, width))
    header = ("world", "method", "θ_p", "intervals that hold", "error [%], median", "half-width [%], median")
    return Table("Do 95 % intervals of θ_p after ten seconds of usual flight hold the truth?", header, lines)


def expectation_table(rows: Results) -> Table:
    """A line for each world: the share of other flights whose error is in the interval that was expected."""
    known = _auto(rows).where(lambda row: row["expected 0.1 s"] is not None)
    columns = {name: lambda own, name=name: f"{_expected(own, name):.0%}" for name in ("0.1 s", "1 s")}
    title = "Do 80 % intervals of the errors to expect hold those of other flights?"
    return tabulate(title, known.group("world"), columns, ("world",))


def method_table(rows: Results) -> Table:
    """A line for each world, change and method: error, the same over the source's, processor time."""
    compared = rows.where(flight="moving").group("world", "change")
    several = [own for own in compared.values() if len(own.unique("method")) > 1]
    lines = []
    for own in several:
        for (world, change, method), each in own.group("world", "change", "method").items():
            ratio = each.numbers("ratio")
            numbers = each.numbers("test_mse").mean(), ratio.mean(), ratio.max(), np.median(each.numbers("seconds"))
            lines.append((world, change, method, *(f"{number:.3g}" for number in numbers)))
    header = ("world", "change", "method", "test error", "over the source's", "worst", "processor time [s], median")
    return Table("Methods on the same ten seconds", header, lines)


def _auto(rows: Results) -> Results:
    return rows.where(method=AUTO)


def _cases(rows: Results) -> dict:
    return _auto(rows).group(*CASE)


def _inside(rows: Results, name: str) -> list[bool]:
    return [row[f"{name}_inside"] for row in rows if row[f"{name}_inside"] is not None]


def _expected(rows: Results, horizon: str) -> float:
    return float(np.mean([row[f"expected {horizon}"] for row in rows if row[f"expected {horizon}"] is not None]))


def _intervals_hold(rows: Results) -> Part:
    def of(world: str, own: Results) -> Part:
        inside = [each for name in LEARNED for each in _inside(own, name)]
        if not inside:
            return None, f"{world} has none"
        share = float(np.mean(inside))
        return HELD[0] <= share <= HELD[1], f"{world} {share:.1%} of {len(inside)}"

    return all_of(of(str(world), own) for world, own in _auto(rows).group("world").items())


def _expects_its_errors(rows: Results) -> Part:
    known = _auto(rows).where(lambda row: row["expected 0.1 s"] is not None)
    if not len(known):
        raise Undecided("no errors were expected")

    def of(world: str, own: Results, horizon: str) -> Part:
        share = _expected(own, horizon)
        return EXPECTED[0] <= share <= EXPECTED[1], f"{world} after {horizon} {share:.0%}"

    groups = known.group("world").items()
    return all_of(of(str(world), own, horizon) for world, own in groups for horizon in ("0.1 s", "1 s"))


CLAIMS = (
    Claim(
        "W1",
        f"In every case the adapted model errs at most {MEAN} times as much as its source in the mean, and at most "
        f"{EACH} times in each adaptation.",
        _never_worse,
    ),
    Claim(
        "W2",
        f"In each world {HELD[0]:.0%} to {HELD[1]:.0%} of the 95 % intervals of Ix, Iy and k hold the truth.",
        _intervals_hold,
    ),
    Claim(
        "W3",
        f"In each world the 80 % intervals of the errors to expect hold those of other flights in {EXPECTED[0]:.0%} to "
        f"{EXPECTED[1]:.0%} of cases, after 0.1 s and after 1 s.",
        _expects_its_errors,
    ),
)
