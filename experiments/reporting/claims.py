"""Hypotheses about results as data: each is evaluated to holds, fails or inconclusive, with the numbers behind it."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

from experiments.reporting.tables import Table

Evidence = TypeVar("Evidence")
Part = tuple[bool, str]  # whether a hypothesis holds in one case, and the numbers behind that
OUTCOMES = {True: "✓ holds", False: "✗ fails", None: "– inconclusive"}


class Inconclusive(Exception):
    """The results cannot decide a claim; the message says why."""


@dataclass(frozen=True)
class Claim(Generic[Evidence]):
    """A hypothesis, and a function that decides it or raises `Inconclusive`."""

    id: str  # such as "C1"
    text: str
    predicate: Callable[[Evidence], Part]


@dataclass(frozen=True)
class Verdict:
    """The outcome of a claim: `holds` is None if the results are inconclusive, and `measured` then says why."""

    id: str
    text: str
    holds: bool | None
    measured: str


def all_of(parts: Iterable[Part]) -> Part:
    """Whether all parts of a hypothesis hold, and their numbers."""
    holds, measured = zip(*parts, strict=True)
    return all(holds), "; ".join(measured)


def evaluate(claims: Iterable[Claim[Evidence]], evidence: Evidence) -> list[Verdict]:

    def verdict(claim: Claim[Evidence]) -> Verdict:
        try:
            holds, measured = claim.predicate(evidence)
            return Verdict(claim.id, claim.text, bool(holds), measured)
        except Inconclusive as why:
            return Verdict(claim.id, claim.text, None, str(why))

    return [verdict(claim) for claim in claims]


def verdict_table(verdicts: Sequence[Verdict], title: str) -> Table:
    lines = [(each.id, each.text, OUTCOMES[each.holds], each.measured) for each in verdicts]
    return Table(title, ("", "claim", "verdict", "measured"), lines)


def to_json(verdicts: Sequence[Verdict]) -> dict[str, list[dict[str, Any]]]:
    """The keys of report.json: `claims` that were decided, and `not_judged` for those that are inconclusive."""
    return {
        "claims": [vars(each) for each in verdicts if each.holds is not None],
        "not_judged": [{"id": v.id, "text": v.text, "why": v.measured} for v in verdicts if v.holds is None],
    }
