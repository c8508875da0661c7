"""The paper's claims (Sec. 4.4 to 4.7); the text of each states how it is evaluated."""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from typing import Any

from experiments.paper.lanes import DOMAINS, cells, gain
from experiments.reporting import names
from experiments.reporting.claims import Claim, Inconclusive, Part, Verdict, all_of, evaluate
from experiments.reporting.names import EXTERNAL_FORCE, FINE_TUNED, HYBRID, NO_PHYSICS, TARGET_ONLY, label
from experiments.reporting.results import Results, Spread

COMPARISON = "comparison"  # the experiment on both domains (Table 2)
DOMAINS_OF = {"param_shift": DOMAINS[:1], "external_force": DOMAINS[1:], COMPARISON: DOMAINS}
CLEARLY = 1.5  # C7, C8: a ratio of mean errors from which one is clearly worse than the other
EQUAL_FROM = 500  # C7: the paper's "500 or more"
FEW, MANY = 100, 1000  # C8, C9: ten seconds of flight and a hundred
THETA_TOLERANCE = 0.05  # C10


@dataclass(frozen=True)
class Evidence:
    """The rows of one domain, by cell, and the target vehicle's true Ix, Iy [kg m²] and k [N/(rad/s)²]."""

    domain: str
    cells: Mapping[tuple[str, str, int], Results]
    truth: Mapping[str, float] | None

    def sizes(self) -> list[int]:
        """Each N that a model with a network was fine-tuned with."""
        found = {n for model, mode, n in self.cells if mode == FINE_TUNED and model != names.PHYSICS_ONLY}
        if not found:
            raise Inconclusive("there are no fine_tuned rows")
        return sorted(found)

    def rows(self, model: str, n: int, mode: str = FINE_TUNED, seeds: int = 1) -> Results:
        """The rows of a cell, of at least so many seeds."""
        rows = self.cells.get((model, mode, n))
        if rows is None:
            raise Inconclusive(f"there are no rows of {model} {mode} at N = {n}")
        if len(rows) < seeds:
            raise Inconclusive(f"needs {seeds} seeds, {model} {mode} at N = {n} has {len(rows)}")
        return rows

    def mse(self, *cell: Any, **seeds: int) -> Spread:
        return self.rows(*cell, **seeds).spread("test_mse")

    def rho(self, model: str, n: int) -> float:
        return self.rows(model, n).spread(gain).mean


Predicate = Callable[[Evidence], Iterator[Part]]


def claims(rows: Results, experiment: str, truth: Mapping[str, float] | None) -> list[Verdict]:
    """Evaluate the claims about one of DOMAINS_OF. An error that is not finite counts as infinite."""
    evidence = [Evidence(domain, cells(rows.where(domain=domain)), truth) for domain in DOMAINS_OF[experiment]]
    own = [id for id in CLAIMS if experiment in ONLY.get(id, ("param_shift", "external_force"))]
    return evaluate([Claim(id, CLAIMS[id][0], partial(_in_each_domain, CLAIMS[id][1])) for id in own], evidence)


def _in_each_domain(predicate: Predicate, evidence: Sequence[Evidence]) -> Part:
    """Whether a claim holds in each domain; it is inconclusive if it is so in one."""

    def part(e: Evidence) -> Part:
        place = f"{label(e.domain)}: " if len(evidence) > 1 else ""
        try:
            holds, measured = all_of(predicate(e))
        except Inconclusive as why:
            raise Inconclusive(f"{place}{why}") from None
        return holds, f"{place}{measured}"

    return all_of(map(part, evidence))


def _hybrid_better(value: Callable[[Evidence, str, int], float], sign: int = 1) -> Predicate:
    """At every N, a value of the hybrid is below (with sign −1 above) that of no-physics."""

    def predicate(e: Evidence) -> Iterator[Part]:
        for n in e.sizes():
            hybrid, plain = (value(e, model, n) for model in (HYBRID, NO_PHYSICS))
            yield sign * hybrid < sign * plain, f"N = {n}: hybrid {hybrid:.3g}, no-physics {plain:.3g}"

    return predicate


def _only_hybrid_adapts(e: Evidence) -> Iterator[Part]:
    n = e.sizes()[0]
    hybrid, plain, group = e.rho(HYBRID, n), e.rho(NO_PHYSICS, n), e.rows(NO_PHYSICS, n)
    failed = sum(row["status"] == "diverged" or row["test_mse"] is None for row in group)
    fails = plain < 0 or (e.domain == EXTERNAL_FORCE and 2 * failed >= len(group))
    words = f"N = {n}: mean ρ of hybrid {hybrid:.3g}, of no-physics {plain:.3g}"
    yield fails and hybrid > 0, f"{words} ({failed} of its {len(group)} seeds diverged or not finite)"


def _falls_with_n(e: Evidence) -> Iterator[Part]:
    sizes = e.sizes()
    if len(sizes) < 2:
        raise Inconclusive("needs two sizes N")
    for model in (HYBRID, NO_PHYSICS):
        means = {n: e.mse(model, n).mean for n in sizes}
        rises = [f"{small} to {large}" for small, large in pairwise(sizes) if not means[large] < means[small]]
        lower = "below" if means[sizes[-1]] < means[sizes[0]] else "not below"
        trend = f"does not fall from {', '.join(rises)}" if rises else "falls at every step"
        shown = ", ".join(f"{mean:.3g}" for mean in means.values())
        yield not rises, f"{label(model)} {trend} ({shown}; the last is {lower} the first)"


def _beats_source_only(e: Evidence) -> Iterator[Part]:
    means = {n: e.rho(HYBRID, n) for n in e.sizes()}
    return ((mean > 0, f"N = {n}: ρ = {mean:.3g}") for n, mean in means.items())


def _pretraining_helps_when_small(e: Evidence) -> Iterator[Part]:
    smallest, large = e.sizes()[0], [n for n in e.sizes() if n >= EQUAL_FROM]
    if smallest >= EQUAL_FROM or not large:
        raise Inconclusive(f"needs a size N below {EQUAL_FROM} and one from {EQUAL_FROM} on")
    tuned, alone = (e.mse(HYBRID, smallest, mode, seeds=2) for mode in (FINE_TUNED, TARGET_ONLY))
    apart = tuned.mean + tuned.std < alone.mean - alone.std or alone.non_finite > tuned.non_finite == 0
    for n in (smallest, *large):
        ratio = _ratio(e.mse(HYBRID, n, TARGET_ONLY), e.mse(HYBRID, n))
        holds = ratio >= CLEARLY if n == smallest else 1 / CLEARLY <= ratio <= CLEARLY
        yield holds, f"N = {n}: ratio {ratio:.3g}"
    yield apart, f"one-std intervals at N = {smallest} {'are apart' if apart else 'overlap'}"


def _few_are_enough(e: Evidence) -> Iterator[Part]:
    ratio = _ratio(e.mse(HYBRID, FEW), e.mse(HYBRID, MANY))
    yield ratio <= CLEARLY, f"ratio {ratio:.3g}"


def _ratio(above: Spread, below: Spread) -> float:
    """Of the means; NaN, with which no comparison holds, where both are zero or both are infinite."""
    if below.mean == 0 or above.mean == below.mean == math.inf:
        return math.nan if above.mean in (0, math.inf) else math.inf
    return above.mean / below.mean


def _leads_the_baselines(e: Evidence) -> Iterator[Part]:
    hybrid = e.mse(HYBRID, FEW).mean
    expert = e.mse(names.EXPERT_AUGMENTATION, 0, names.SOURCE_ONLY).smallest
    physics = e.mse(names.PHYSICS_ONLY, FEW).smallest
    words = f"mean of hybrid {hybrid:.3g}, smallest of Expert Augmentation {expert:.3g}, of physics-only {physics:.3g}"
    yield hybrid < expert < physics, words


def _theta_recovered(e: Evidence) -> Iterator[Part]:
    if e.truth is None:
        raise Inconclusive("the true θ_p is not given")
    for n in e.sizes():
        rows = e.rows(HYBRID, n)
        if None in rows["theta"]:
            raise Inconclusive(f"a hybrid row at N = {n} has no theta")
        x, y = (rows.spread(f"theta.{name}").mean / e.truth[name] - 1 for name in ("Ix", "Iy"))
        yield all(abs(off) <= THETA_TOLERANCE for off in (x, y)), f"N = {n}: Ix {x:+.2%}, Iy {y:+.2%}"


ONLY = {"C9": (COMPARISON,), "C10": ("param_shift",)}  # the others are about both shifts, not about the comparison
CLAIMS: Mapping[str, tuple[str, Predicate]] = {
    "C1": ("At every N, the mean test error of the fine-tuned hybrid is below that of fine-tuned no-physics.",
           _hybrid_better(lambda e, model, n: e.mse(model, n).mean)),
    "C2": ("At every N, the mean ρ of the fine-tuned hybrid is above that of fine-tuned no-physics.",
           _hybrid_better(Evidence.rho, sign=-1)),
    "C3": ("At the smallest N, fine-tuned no-physics fails and the hybrid does not: mean ρ of no-physics is below 0 "
           "(under the external force, diverging in at least half of the seeds counts too), that of the hybrid above "
           "0.", _only_hybrid_adapts),
    "C4": ("At every N, the standard deviation over seeds of the test error of the fine-tuned hybrid is below that of "
           "fine-tuned no-physics.", _hybrid_better(lambda e, model, n: e.mse(model, n, seeds=2).std)),
    "C5": ("The mean test error after fine-tuning falls strictly from each N to the next, for hybrid and for "
           "no-physics.", _falls_with_n),
    "C6": ("Fine-tuning beats source-only: the mean ρ of the hybrid is above 0 at every N.", _beats_source_only),
    "C7": (f"Hybrid, mean error of target-only over that of fine-tuned: at least {CLEARLY} at the smallest N, where "
           f"the one-std intervals do not overlap, and between 1/{CLEARLY} and {CLEARLY} at every N from {EQUAL_FROM} "
           "on.", _pretraining_helps_when_small),
    "C8": (f"The mean error of the hybrid fine-tuned with N = {FEW} is at most {CLEARLY} times that with N = {MANY}.",
           _few_are_enough),
    "C9": (f"In both experiments: mean error of the hybrid fine-tuned at N = {FEW} < smallest error over seeds of "
           f"Expert Augmentation < smallest error over seeds of physics-only fine-tuned at N = {FEW}.",
           _leads_the_baselines),
    "C10": (f"Mean Ix and Iy of the fine-tuned hybrid are within {THETA_TOLERANCE:.0%} of the true ones at every N.",
            _theta_recovered),
}  # fmt: skip
