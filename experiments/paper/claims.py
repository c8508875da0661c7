"""The paper's claims (Sec. 4.4 to 4.7), decided by the 95 % interval of a paired difference."""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from typing import Any

from experiments.paper.lanes import DOMAINS, cells, gain
from experiments.reporting import names
from experiments.reporting.claims import Claim, Part, Undecided, Verdict, all_of, evaluate, every
from experiments.reporting.names import EXTERNAL_FORCE, FINE_TUNED, HYBRID, NO_PHYSICS, TARGET_ONLY, label
from experiments.reporting.results import Column, Results, Row
from experiments.reporting.statistics import Estimate, Spread, ratio_of_stds

COMPARISON = "comparison"  # the experiment on both domains (Table 2)
DOMAINS_OF = {"param_shift": DOMAINS[:1], "external_force": DOMAINS[1:], COMPARISON: DOMAINS}
CLEARLY = 1.5  # C7, C8: a ratio of mean errors from which one is clearly worse than the other
EQUAL_FROM = 500  # C7: the paper's "500 or more"
FEW, MANY = 100, 1000  # C8, C9: ten seconds of flight and a hundred
THETA_TOLERANCE = 0.05  # C10


@dataclass(frozen=True)
class PaperEvidence:
    """The rows of one domain, by cell, and the target vehicle's true Ix, Iy [kg m²] and k [N/(rad/s)²]."""

    domain: str
    cells: Mapping[tuple[str, str, int], Results]
    truth: Mapping[str, float] | None

    def sizes(self) -> list[int]:
        found = {n for model, mode, n in self.cells if mode == FINE_TUNED and model != names.PHYSICS_ONLY}
        if not found:
            raise Undecided("there are no fine_tuned rows")
        return sorted(found)

    def rows(self, model: str, n: int, mode: str = FINE_TUNED) -> Results:
        rows = self.cells.get((model, mode, n))
        if rows is None:
            raise Undecided(f"there are no rows of {model} {mode} at N = {n}")
        return rows

    def mse(self, *cell: Any) -> Spread:
        return self.rows(*cell).spread("test_mse")

    def difference(
        self, first: tuple[Any, ...], second: tuple[Any, ...], times: float = 1.0, column: Column = "test_mse"
    ) -> Estimate:
        """Return the mean of the first cell minus `times` the second's, paired by seed and draw."""
        try:
            return self.rows(*first).interval(column, self.rows(*second), times)
        except ValueError as why:
            raise Undecided(f"{label(first[0])} at N = {first[1]}: {why}") from None


Predicate = Callable[[PaperEvidence], Iterator[Part]]


def claims(rows: Results, experiment: str, truth: Mapping[str, float] | None, quick: bool = False) -> list[Verdict]:
    """Evaluate the claims about one of DOMAINS_OF, for a quick preset only `QUICK`; errors not finite are infinite."""
    evidence = [PaperEvidence(domain, cells(rows.where(domain=domain)), truth) for domain in DOMAINS_OF[experiment]]
    own = [id for id in CLAIMS if experiment in ONLY.get(id, ("param_shift", "external_force"))]
    judge = {id: _too_few if quick and id not in QUICK else partial(_in_each_domain, CLAIMS[id][1]) for id in own}
    return evaluate([Claim(id, CLAIMS[id][0], judge[id]) for id in own], evidence)


def _too_few(evidence: Sequence[PaperEvidence]) -> Part:
    raise Undecided("a quick run has too few seeds and sizes to judge this; --preset paper has enough")


def _in_each_domain(predicate: Predicate, evidence: Sequence[PaperEvidence]) -> Part:
    """Whether a claim is true in each domain; it is not judged if one lacks data."""

    def part(e: PaperEvidence) -> Part:
        place = f"{label(e.domain)}: " if len(evidence) > 1 else ""
        try:
            holds, measured = all_of(predicate(e))
        except Undecided as why:
            raise Undecided(f"{place}{why}") from None
        return holds, f"{place}{measured}"

    return all_of(map(part, evidence))


def _lower_error(e: PaperEvidence) -> Iterator[Part]:
    for n in e.sizes():
        hybrid, plain = (e.mse(model, n).mean for model in (HYBRID, NO_PHYSICS))
        difference = e.difference((HYBRID, n), (NO_PHYSICS, n))
        yield difference.below(0), f"N = {n}: hybrid {hybrid:.3g}, no-physics {plain:.3g}, {_minus(difference)}"


def _higher_rho(e: PaperEvidence) -> Iterator[Part]:
    for n in e.sizes():
        hybrid, plain = (e.rows(model, n).spread(gain).mean for model in (HYBRID, NO_PHYSICS))
        difference = e.difference((HYBRID, n), (NO_PHYSICS, n), column=gain)
        yield difference.above(0), f"N = {n}: hybrid {hybrid:.3g}, no-physics {plain:.3g}, {_minus(difference)}"


def _less_spread(e: PaperEvidence) -> Iterator[Part]:
    for n in e.sizes():
        hybrid, plain = (_by_seed(e.rows(model, n)) for model in (HYBRID, NO_PHYSICS))
        if hybrid.keys() != plain.keys():
            raise Undecided(f"hybrid and no-physics have other seeds at N = {n}")
        ratio = ratio_of_stds([*hybrid.values()], [plain[seed] for seed in hybrid])
        yield ratio.below(1), f"N = {n}: hybrid over no-physics {ratio.text()}"


def _by_seed(rows: Results) -> dict[int, float]:
    return {seed: own.spread("test_mse").mean for seed, own in rows.group("seed").items()}


def _only_hybrid_adapts(e: PaperEvidence) -> Iterator[Part]:
    n = e.sizes()[0]
    hybrid, group = e.rows(HYBRID, n).interval(gain), e.rows(NO_PHYSICS, n)
    plain, failed = group.interval(gain), sum(row["status"] == "diverged" or row["test_mse"] is None for row in group)
    diverges = e.domain == EXTERNAL_FORCE and 2 * failed >= len(group)
    yield hybrid.above(0), f"N = {n}: mean ρ of hybrid {hybrid.text()}"
    words = f"of no-physics {plain.text()} ({failed} of its {len(group)} runs diverged or not finite)"
    yield diverges or plain.below(0), words


def _falls_with_n(e: PaperEvidence) -> Iterator[Part]:
    sizes = e.sizes()
    if len(sizes) < 2:
        raise Undecided("needs two sizes N")
    for model in (HYBRID, NO_PHYSICS):
        steps = {f"{few} to {more}": e.difference((model, more), (model, few)) for few, more in pairwise(sizes)}
        shown = ", ".join(f"{step}: {change.text('+.2g')}" for step, change in steps.items())
        yield every(change.below(0) for change in steps.values()), f"{label(model)} from {shown}"


def _beats_source_only(e: PaperEvidence) -> Iterator[Part]:
    means = {n: e.rows(HYBRID, n).interval(gain) for n in e.sizes()}
    return ((mean.above(0), f"N = {n}: ρ = {mean.text()}") for n, mean in means.items())


def pretraining_helps(e: PaperEvidence, few: int, large: Sequence[int], equally: bool = True) -> Iterator[Part]:
    """Significantly with few windows, and not with a large number; `equally`: nor the other way round."""
    for n in (few, *large):
        alone, tuned = (HYBRID, n, TARGET_ONLY), (HYBRID, n)
        most, least = (e.difference(alone, tuned, times) for times in (CLEARLY, 1 / CLEARLY))
        holds = most.above(0) if n == few else every([most.below(0), *[least.above(0)] * equally])
        yield holds, f"N = {n}: ratio {ratio(e.mse(*alone), e.mse(*tuned)):.3g}, {_minus(most, CLEARLY)}"


def _pretraining_helps_when_small(e: PaperEvidence) -> Iterator[Part]:
    smallest, large = e.sizes()[0], [n for n in e.sizes() if n >= EQUAL_FROM]
    if smallest >= EQUAL_FROM or not large:
        raise Undecided(f"needs a size N below {EQUAL_FROM} and one from {EQUAL_FROM} on")
    return pretraining_helps(e, smallest, large)


def few_are_enough(e: PaperEvidence, few: int = FEW, many: int = MANY) -> Iterator[Part]:
    excess = e.difference((HYBRID, few), (HYBRID, many), CLEARLY)
    yield excess.below(0), f"ratio {ratio(e.mse(HYBRID, few), e.mse(HYBRID, many)):.3g}, {_minus(excess, CLEARLY)}"


def ratio(above: Spread, below: Spread) -> float:
    """Return the ratio of the means; NaN if both are zero or infinite."""
    if below.mean == 0 or above.mean == below.mean == math.inf:
        return math.nan if above.mean in (0, math.inf) else math.inf
    return above.mean / below.mean


def _minus(difference: Estimate, times: float = 1.0) -> str:
    return f"difference {difference.text()}" if times == 1 else f"first − {times} × second {difference.text()}"


def _leads_the_baselines(e: PaperEvidence) -> Iterator[Part]:
    expert = names.EXPERT_AUGMENTATION, 0, names.SOURCE_ONLY
    groups = e.rows(HYBRID, FEW), e.rows(*expert), e.rows(names.PHYSICS_ONLY, FEW)
    seeds = sorted({seed for rows in groups for seed in rows["seed"]})

    def leads(keep: Callable[[Row], bool]) -> bool:
        hybrid, expert, physics = (rows.where(keep).numbers("test_mse") for rows in groups)
        return hybrid.mean() < expert.min() < physics.min() if len(hybrid) and len(expert) and len(physics) else False

    found = {leads(lambda row, seed=seed: row["seed"] != seed) for seed in seeds}
    mean, best, physics = groups[0].spread("test_mse").mean, *(rows.spread("test_mse").smallest for rows in groups[1:])
    words = f"mean of hybrid {mean:.3g}, smallest of Expert Augmentation {best:.3g}, of physics-only {physics:.3g}"
    if len(seeds) < 2 or len(found | {leads(lambda row: True)}) > 1:
        yield None, f"{words}; {'one seed' if len(seeds) < 2 else 'rests on one seed'}"
    else:
        yield found == {True}, words


def _theta_recovered(e: PaperEvidence) -> Iterator[Part]:
    if e.truth is None:
        raise Undecided("the true θ_p is not given")
    for n in e.sizes():
        rows = e.rows(HYBRID, n)
        if None in rows["theta"]:
            raise Undecided(f"a hybrid row at N = {n} has no theta")
        for name in ("Ix", "Iy"):
            limit, truth = 100 * THETA_TOLERANCE, e.truth[name]
            off = rows.interval(lambda row, name=name, truth=truth: _bias(row["theta"][name], truth))
            yield every([off.below(limit), off.above(-limit)]), f"N = {n}: {name} {off.text('+.2f')} %"


def _bias(value: float | None, truth: float) -> float:
    return math.inf if value is None else 100 * (value / truth - 1)


QUICK = ("C1", "C2", "C6", "C9")  # what three seeds and the smallest and the largest N decide
ONLY = {"C9": (COMPARISON,), "C10": ("param_shift",)}  # the others are about both shifts, not about the comparison
_DEPENDS = "After a change of inertia this is sensitive to the rate of θ_p in fine-tuning, an option."
CLAIMS: Mapping[str, tuple[str, Predicate]] = {
    "C1": ("At every N, the mean test error of the fine-tuned hybrid is below that of fine-tuned no-physics (95 % "
           "interval of the paired difference, as for all claims about means).", _lower_error),
    "C2": ("At every N, the mean ρ of the fine-tuned hybrid is above that of fine-tuned no-physics.", _higher_rho),
    "C3": ("At the smallest N, fine-tuned no-physics fails and the hybrid does not: mean ρ of no-physics is below 0 "
           "(in the side wind, diverging in at least half of the runs counts too), that of the hybrid above "
           "0.", _only_hybrid_adapts),
    "C4": ("At every N, the standard deviation over seeds of the test error of the fine-tuned hybrid is below that of "
           "fine-tuned no-physics (test of Pitman and Morgan for paired variances).", _less_spread),
    "C5": ("The mean test error after fine-tuning falls strictly from each N to the next, for hybrid and for "
           "no-physics.", _falls_with_n),
    "C6": ("Fine-tuning beats source-only: the mean ρ of the hybrid is above 0 at every N.", _beats_source_only),
    "C7": (f"Hybrid, mean error of target-only over that of fine-tuned: at least {CLEARLY} at the smallest N, and "
           f"between 1/{CLEARLY} and {CLEARLY} at every N from {EQUAL_FROM} on (equivalence: the interval lies "
           "inside).", _pretraining_helps_when_small),
    "C8": (f"The mean error of the hybrid fine-tuned with N = {FEW} is at most {CLEARLY} times that with N = {MANY}. "
           f"{_DEPENDS}", few_are_enough),
    "C9": (f"In both experiments: mean error of the hybrid fine-tuned at N = {FEW} < smallest error over seeds of "
           f"Expert Augmentation < smallest error over seeds of physics-only fine-tuned at N = {FEW}. It holds, or "
           "fails, if it still does with any one seed left out.", _leads_the_baselines),
    "C10": (f"Mean Ix and Iy of the fine-tuned hybrid are within {THETA_TOLERANCE:.0%} of the true ones at every N "
            f"(equivalence: the interval lies inside). {_DEPENDS}", _theta_recovered),
}  # fmt: skip
