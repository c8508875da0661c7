"""Tables and claims of the three studies."""

import math
from collections.abc import Callable, Iterable, Mapping

from experiments.paper.claims import CLAIMS, CLEARLY, PaperEvidence, few_are_enough, pretraining_helps
from experiments.paper.lanes import cells
from experiments.reaction_diffusion import forecast, gray_scott, shifted
from experiments.reaction_diffusion.config import LOCAL, POINTWISE
from experiments.reaction_diffusion.shifted import AUTO
from experiments.reporting.claims import Claim, Part, Undecided, all_of
from experiments.reporting.names import FINE_TUNED, HYBRID, LEAST_SQUARES, NO_PHYSICS, SOURCE_ONLY, TARGET_ONLY, label
from experiments.reporting.results import Results
from experiments.reporting.tables import Table, cross_table, over_seeds, spread_text, tabulate

# log10 MSE of forecasts and error of a and b, from Table 1 of Yin et al. 2021 (reaction-diffusion).
PUBLISHED = (
    ("published: neural ODE", "−3.76", "–"),
    ("published: PredRNN++", "−4.60", "–"),
    ("published: APHYNITY, without its least action", "−4.56", "6.4"),
    ("published: APHYNITY", "−5.10 ± 0.21", "2.3"),
    ("published: physics alone, complete", "−9.35", "–"),
)
FIRST = (POINTWISE, "convolution", LOCAL, "no physics, convolution")  # of our own cases
APHYNITY = 10**-5.10  # the mean squared error in that table
SCOTT_PUBLISHED = {"Neural Context Flows, best": 1.4e-3, "another run": 3.4e-3}
LIMITS = {LOCAL: (-5.3, 2.0), POINTWISE: (-7.0, 0.2)}  # asked: log10 MSE, error of a and b [%]
SCOTT_COLUMNS = ("found_F", "found_k", "mse_before", "mse")
WAYS = (
    (HYBRID, SOURCE_ONLY), (HYBRID, LEAST_SQUARES), (HYBRID, AUTO), (HYBRID, FINE_TUNED), (HYBRID, TARGET_ONLY),
    (NO_PHYSICS, SOURCE_ONLY), (NO_PHYSICS, FINE_TUNED), (NO_PHYSICS, TARGET_ONLY),
)  # fmt: skip
WORDS = {LEAST_SQUARES: "least squares on a, b", AUTO: "hj.adapt"}
SHIFT_WORDS = {"parameter_shift": "a × 2, b ÷ 2, k × 2", "new_term": "a new term, −0.5 u v"}


def log_mse(row: Mapping) -> float:
    return math.inf if row["mse"] is None else math.log10(row["mse"])


def tables(rows: Results) -> list[Table]:
    found, parts = [], set(rows["part"])
    if forecast.PART in parts:
        found.append(_forecasts(rows.where(part=forecast.PART)))
    if shifted.PART in parts:
        found += [_shift(name, own) for name, own in rows.where(part=shifted.PART).group("shift").items()]
        found.append(_choices(rows.where(part=shifted.PART, mode=AUTO)))
    if gray_scott.PART in parts:
        found.append(_environments(rows.where(part=gray_scott.PART)))
    return found


def conclusion(rows: Results) -> list[str]:
    own = rows.where(part=forecast.PART, case=POINTWISE)
    if not len(own):
        return []
    error = f"{own.spread('mse').median:.1g}"
    return [f"After one trajectory its forecasts have a mean squared error of {error}; {APHYNITY:.1g} was published."]


def _forecasts(rows: Results) -> Table:
    groups = rows.group("case")
    columns: dict[str, Callable[[Results], str]] = {
        "log10 MSE": lambda own: spread_text(own.spread(log_mse), ".2f"),
        "error of a, b [%]": lambda own: "–" if own[0]["a"] is None else spread_text(own.spread("parameter_error")),
        "seeds": lambda own: str(len(own)),
    }
    table = tabulate("Forecasts of 2.5 s from one trajectory of FitzHugh–Nagumo", groups, columns)
    own = sorted(table.lines, key=lambda line: line[0] not in FIRST)
    return table._replace(lines=[*own[: len(FIRST)], *((*line, "") for line in PUBLISHED), *own[len(FIRST) :]])


def _shift(name: str, rows: Results) -> Table:
    groups = {_way(*way): own for way in WAYS if len(own := rows.where(model=way[0], mode=way[1]))}
    columns = {f"N = {n}": {"n": (n, 0)} for n in sorted(set(rows["n"]) - {0})}
    title = f"{SHIFT_WORDS[name]}: mean squared error of forecasts after N trajectories, {over_seeds(rows)}"
    return cross_table(title, groups, columns, lambda own: spread_text(own.spread("mse")))


def _way(model: str, mode: str) -> str:
    return f"{label(model)}, {WORDS.get(mode, label(mode))}"


def _choices(rows: Results) -> Table:
    groups = {SHIFT_WORDS[shift]: own for shift, own in rows.group("shift").items()}
    columns = {f"N = {n}": {"n": n} for n in sorted(set(rows["n"]))}

    def chosen(own: Results) -> str:
        return ", ".join(f"{name} {len(same)}" for name, same in own.group("chosen").items())

    return cross_table("What hj.adapt (auto) chose, and in how many seeds", groups, columns, chosen, "change")


def _environments(rows: Results) -> Table:
    lines = [(f"F = {row['F']}, k = {row['k']}", *(f"{row[name]:.4g}" for name in SCOTT_COLUMNS)) for row in rows]
    lines.append(("mean", "", "", *(f"{rows.spread(name).mean:.4g}" for name in SCOTT_COLUMNS[2:])))
    lines += [(f"published: {name}", "", "", "", f"{value:.4g}") for name, value in SCOTT_PUBLISHED.items()]
    header = ("environment", "F found", "k found", "MSE before", "MSE adapted")
    return Table("Gray–Scott: four new environments, F and k adapted to one trajectory of each", header, lines)


def claims(rows: Results) -> list[Claim[Results]]:
    found = [Claim(f"G{i}", *_goal(case)) for i, case in enumerate(LIMITS, 1) if len(rows.where(case=case))]
    if len(rows.where(part=gray_scott.PART)):
        found.append(
            Claim("G3", "Gray–Scott: the mean error in new environments is below the best published, 1.4e-3.", _scott)
        )
    for shift in sorted(set(rows.where(part=shifted.PART)["shift"])):
        found += [Claim(f"{name} {shift}", text, _under(shift, of)) for name, (text, of) in PAPER_CLAIMS.items()]
    return found


def _under(shift: str, parts: Callable[[PaperEvidence], Iterable[Part]]) -> Callable[[Results], Part]:
    """Return a claim about one change, of the paper's models and modes, by the columns of the paper's rows."""

    def judged(rows: Results) -> Part:
        own = rows.where(shift=shift, model=(HYBRID, NO_PHYSICS), mode=(FINE_TUNED, TARGET_ONLY))
        named = Results([{**row, "n_train": row["n"], "test_mse": row["mse"], "status": ""} for row in own])
        return all_of(parts(PaperEvidence(shift, cells(named), None)))

    return judged


def _goal(case: str):
    limit, share = LIMITS[case]

    def met(rows: Results) -> Part:
        own = rows.where(case=case)
        worst, off = own.numbers(log_mse).max(), own.numbers("parameter_error").max()
        return bool(worst < limit and off < share), f"worst of {len(own)} seeds: {worst:.2f}, {off:.3g} %"

    return f"{case}, one trajectory: log10 MSE below {limit:g}, a and b within {share:g} % in every seed.", met


def _scott(rows: Results) -> Part:
    mean = rows.where(part=gray_scott.PART).spread("mse").mean
    return mean < SCOTT_PUBLISHED["Neural Context Flows, best"], f"mean {mean:.2e}"


def _ends(e: PaperEvidence) -> tuple[int, int]:
    if len(sizes := e.sizes()) < 2:
        raise Undecided("needs two sizes N")
    return sizes[0], sizes[-1]


# The first six are the paper's own; the last two are of other sizes.
PAPER_CLAIMS = {id: CLAIMS[id] for id in ("C1", "C2", "C3", "C4", "C5", "C6")} | {
    "C7": (
        f"Error of target-only over that of fine-tuned: at least {CLEARLY} at the smallest N, less at the largest.",
        lambda e: pretraining_helps(e, _ends(e)[0], _ends(e)[1:], equally=False),
    ),
    "C8": (
        f"The error of the hybrid with the smallest N is at most {CLEARLY} times that with the largest.",
        lambda e: few_are_enough(e, *_ends(e)),
    ),
}
