"""The paper's claims (Sec. 4.4 to 4.7), each judged on the rows by a definition that its own text states."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, NamedTuple

from experiments.paper.rows import DOMAIN_OF, DOMAINS, NAMES, Row, check_unique
from experiments.paper.summary import Cell, Spread, Summary, grouped, spread, summarise

COMPARISON = "comparison"  # the experiment on both domains (Table 2)
EXPERIMENTS = (*DOMAIN_OF, COMPARISON)
CLEARLY = 1.5  # C7, C8: a ratio of mean errors from which one is clearly worse than the other
EQUAL_FROM = 500  # C7: the paper's "500 or more"
FEW, MANY = 100, 1000  # C8, C9: ten seconds of flight and a hundred
THETA_TOLERANCE = 0.05  # C10


@dataclass(frozen=True)
class Claim:
    """A claim, its verdict and the numbers behind it.

    Attributes:
        id: as in the list of claims, "C1".
        text: the claim with its definition.
        holds: the verdict; None if these rows cannot judge it.
        measured: the numbers, or why it cannot be judged.
    """

    id: str
    text: str
    holds: bool | None
    measured: str


class _NotJudged(Exception):
    """Why the rows at hand cannot judge a claim."""


@dataclass(frozen=True)
class _Evidence:
    """The rows of one domain."""

    domain: str
    rows: list[Row]
    summaries: Mapping[Cell, Summary]
    truth: Mapping[str, float] | None

    def sizes(self) -> list[int]:
        found = {n for model, mode, n in self.summaries if mode == "fine_tuned" and model != "physics_only"}
        if not found:
            raise _NotJudged("there are no fine_tuned rows")
        return sorted(found)

    def cell(self, model: str, n: int, mode: str = "fine_tuned", seeds: int = 1) -> Summary:
        summary = self.summaries.get((model, mode, n))
        if summary is None:
            raise _NotJudged(f"there are no rows of {model} {mode} at N = {n}")
        if summary.mse.count < seeds:
            raise _NotJudged(f"needs {seeds} seeds, {model} {mode} at N = {n} has {summary.mse.count}")
        return summary


class _Rule(NamedTuple):
    id: str
    text: str
    judge: Callable[[_Evidence], tuple[bool, str]]
    experiments: tuple[str, ...] = tuple(DOMAIN_OF)


def claims(rows: Iterable[Row], experiment: str, truth_theta: Mapping[str, float] | None) -> list[Claim]:
    """Judge the claims about an experiment. An error that was not finite counts as infinite.

    C1 to C8 are about an experiment on one domain, of which they see the rows, C10 about the parameter shift, and C9
    about the comparison on both domains.

    Args:
        truth_theta: the target vehicle's Ix, Iy [kg m²] and k [N/(rad/s)²].

    Raises:
        ValueError: an experiment that these claims are not about, or a row that stands twice.
    """
    if experiment not in EXPERIMENTS:
        raise ValueError(f"experiment must be one of {', '.join(EXPERIMENTS)}, got {experiment!r}")
    rows = check_unique(rows)
    domains = DOMAINS if experiment == COMPARISON else (DOMAIN_OF[experiment],)
    evidence = [_evidence(domain, rows, truth_theta) for domain in domains]
    return [_judged(rule, evidence) for rule in _RULES if experiment in rule.experiments]


def _evidence(domain: str, rows: list[Row], truth: Mapping[str, float] | None) -> _Evidence:
    own = [row for row in rows if row.domain == domain]
    return _Evidence(domain, own, summarise(own), truth)


def _judged(rule: _Rule, evidence: list[_Evidence]) -> Claim:
    """On several domains a claim must hold in each, and is not judged if it cannot be in one."""
    verdicts, words = [], []
    for part in evidence:
        place = f"{NAMES[part.domain]}: " if len(evidence) > 1 else ""
        try:
            holds, measured = rule.judge(part)
        except _NotJudged as why:
            return Claim(rule.id, rule.text, None, f"{place}{why}")
        verdicts.append(bool(holds))
        words.append(f"{place}{measured}")
    return Claim(rule.id, rule.text, all(verdicts), "; ".join(words))


def _hybrid_against_no_physics(
    evidence: _Evidence, value: Callable[[Summary], float], better: Callable[[float, float], bool], seeds: int = 1
) -> tuple[bool, str]:
    models = ("hybrid", "no_physics")
    pairs = {n: [value(evidence.cell(model, n, seeds=seeds)) for model in models] for n in evidence.sizes()}
    words = [f"N = {n}: hybrid {hybrid:.3g}, no-physics {plain:.3g}" for n, (hybrid, plain) in pairs.items()]
    return all(better(*pair) for pair in pairs.values()), "; ".join(words)


def _smaller_error(evidence: _Evidence) -> tuple[bool, str]:
    return _hybrid_against_no_physics(evidence, lambda cell: cell.mse.mean, lambda hybrid, plain: hybrid < plain)


def _higher_rho(evidence: _Evidence) -> tuple[bool, str]:
    return _hybrid_against_no_physics(evidence, lambda cell: cell.rho.mean, lambda hybrid, plain: hybrid > plain)


def _smaller_spread(evidence: _Evidence) -> tuple[bool, str]:
    return _hybrid_against_no_physics(
        evidence, lambda cell: cell.mse.std, lambda hybrid, plain: hybrid < plain, seeds=2
    )


def _only_hybrid_adapts(evidence: _Evidence) -> tuple[bool, str]:
    n = evidence.sizes()[0]
    hybrid, plain = evidence.cell("hybrid", n), evidence.cell("no_physics", n)
    group = [row for row in evidence.rows if (row.model, row.mode, row.n_train) == ("no_physics", "fine_tuned", n)]
    failed = sum(row.status == "diverged" or row.test_mse is None for row in group)
    fails = plain.rho.mean < 0 or (evidence.domain == "external_force" and 2 * failed >= len(group))
    words = f"N = {n}: mean ρ of hybrid {hybrid.rho.mean:.3g}, of no-physics {plain.rho.mean:.3g}"
    return fails and hybrid.rho.mean > 0, f"{words} ({failed} of its {len(group)} seeds diverged or not finite)"


def _falls_with_n(evidence: _Evidence) -> tuple[bool, str]:
    sizes = evidence.sizes()
    if len(sizes) < 2:
        raise _NotJudged("needs two sizes N")
    verdicts, words = [], []
    for model in ("hybrid", "no_physics"):
        means = {n: evidence.cell(model, n).mse.mean for n in sizes}
        rises = [f"{small} to {large}" for small, large in pairwise(sizes) if not means[large] < means[small]]
        lower = "below" if means[sizes[-1]] < means[sizes[0]] else "not below"
        trend = f"does not fall from {', '.join(rises)}" if rises else "falls at every step"
        shown = ", ".join(f"{mean:.3g}" for mean in means.values())
        words.append(f"{model.replace('_', '-')} {trend} ({shown}; the last is {lower} the first)")
        verdicts.append(not rises)
    return all(verdicts), "; ".join(words)


def _beats_source_only(evidence: _Evidence) -> tuple[bool, str]:
    means = {n: evidence.cell("hybrid", n).rho.mean for n in evidence.sizes()}
    return min(means.values()) > 0, "; ".join(f"N = {n}: ρ = {mean:.3g}" for n, mean in means.items())


def _pretraining_helps_when_small(evidence: _Evidence) -> tuple[bool, str]:
    smallest, large = evidence.sizes()[0], [n for n in evidence.sizes() if n >= EQUAL_FROM]
    if smallest >= EQUAL_FROM or not large:
        raise _NotJudged(f"needs a size N below {EQUAL_FROM} and one from {EQUAL_FROM} on")
    ratios = {n: _ratio(_target_only(evidence, n), evidence.cell("hybrid", n).mse) for n in (smallest, *large)}
    tuned, alone = evidence.cell("hybrid", smallest, seeds=2).mse, _target_only(evidence, smallest, seeds=2)
    apart = tuned.mean + tuned.std < alone.mean - alone.std or alone.non_finite > tuned.non_finite == 0
    near = all(1 / CLEARLY <= ratios[n] <= CLEARLY for n in large)
    words = "; ".join(f"N = {n}: ratio {ratio:.3g}" for n, ratio in ratios.items())
    intervals = "are apart" if apart else "overlap"
    return ratios[smallest] >= CLEARLY and apart and near, f"{words}; one-std intervals at N = {smallest} {intervals}"


def _target_only(evidence: _Evidence, n: int, seeds: int = 1) -> Spread:
    return evidence.cell("hybrid", n, "target_only", seeds).mse


def _few_are_enough(evidence: _Evidence) -> tuple[bool, str]:
    ratio = _ratio(evidence.cell("hybrid", FEW).mse, evidence.cell("hybrid", MANY).mse)
    return ratio <= CLEARLY, f"ratio {ratio:.3g}"


def _ratio(above: Spread, below: Spread) -> float:
    """Of the means; NaN, with which no comparison holds, where both are zero or both are infinite."""
    if below.mean == 0 or above.mean == below.mean == float("inf"):
        return float("nan") if above.mean in (0, float("inf")) else float("inf")
    return above.mean / below.mean


def _leads_the_rivals(evidence: _Evidence) -> tuple[bool, str]:
    hybrid = evidence.cell("hybrid", FEW).mse.mean
    expert = evidence.cell("expert_augmentation", 0, "source_only").mse.smallest
    physics = evidence.cell("physics_only", FEW).mse.smallest
    words = f"mean of hybrid {hybrid:.3g}, smallest of Expert Augmentation {expert:.3g}, of physics-only {physics:.3g}"
    return hybrid < expert < physics, words


def _theta_recovered(evidence: _Evidence) -> tuple[bool, str]:
    if evidence.truth is None:
        raise _NotJudged("the true θ_p is not given")
    off = {(n, name): _bias(evidence, n, name) for n in evidence.sizes() for name in ("Ix", "Iy")}
    words = [f"N = {n}: Ix {off[n, 'Ix']:+.2%}, Iy {off[n, 'Iy']:+.2%}" for n in evidence.sizes()]
    return all(abs(bias) <= THETA_TOLERANCE for bias in off.values()), "; ".join(words)


def _bias(evidence: _Evidence, n: int, name: str) -> float:
    evidence.cell("hybrid", n)
    group: list[Any] = [row.theta for row in grouped(evidence.rows)["hybrid", "fine_tuned", n]]
    if None in group or evidence.truth is None:
        raise _NotJudged(f"a hybrid row at N = {n} has no theta")
    values = [float("inf") if theta[name] is None else theta[name] for theta in group]
    return spread(values).mean / evidence.truth[name] - 1


_RULES = (
    _Rule(
        "C1",
        "At every N, the mean test error of the fine-tuned hybrid is below that of fine-tuned no-physics.",
        _smaller_error,
    ),
    _Rule("C2", "At every N, the mean ρ of the fine-tuned hybrid is above that of fine-tuned no-physics.", _higher_rho),
    _Rule(
        "C3",
        "At the smallest N, fine-tuned no-physics fails and the hybrid does not: mean ρ of no-physics is below 0 "
        "(under the external force, diverging in at least half of the seeds counts too), that of the hybrid above 0.",
        _only_hybrid_adapts,
    ),
    _Rule(
        "C4",
        "At every N, the standard deviation over seeds of the test error of the fine-tuned hybrid is below that of "
        "fine-tuned no-physics.",
        _smaller_spread,
    ),
    _Rule(
        "C5",
        "The mean test error after fine-tuning falls strictly from each N to the next, for hybrid and for no-physics.",
        _falls_with_n,
    ),
    _Rule("C6", "Fine-tuning beats source-only: the mean ρ of the hybrid is above 0 at every N.", _beats_source_only),
    _Rule(
        "C7",
        f"Hybrid, mean error of target-only over that of fine-tuned: at least {CLEARLY} at the smallest N, where the "
        f"one-std intervals do not overlap, and between 1/{CLEARLY} and {CLEARLY} at every N from {EQUAL_FROM} on.",
        _pretraining_helps_when_small,
    ),
    _Rule(
        "C8",
        f"The mean error of the hybrid fine-tuned with N = {FEW} is at most {CLEARLY} times that with N = {MANY}.",
        _few_are_enough,
    ),
    _Rule(
        "C9",
        f"In both experiments: mean error of the hybrid fine-tuned at N = {FEW} < smallest error over seeds of Expert "
        f"Augmentation < smallest error over seeds of physics-only fine-tuned at N = {FEW}.",
        _leads_the_rivals,
        (COMPARISON,),
    ),
    _Rule(
        "C10",
        f"Mean Ix and Iy of the fine-tuned hybrid are within {THETA_TOLERANCE:.0%} of the true ones at every N.",
        _theta_recovered,
        ("param_shift",),
    ),
)
