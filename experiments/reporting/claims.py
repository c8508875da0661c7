"""Hypotheses about results as data: each is evaluated to holds, fails or inconclusive, with the numbers behind it."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

from experiments.reporting.tables import Table

Evidence = TypeVar("Evidence")
OUTCOMES = {True: "✓ holds", False: "✗ fails", None: "– inconclusive"}


class Inconclusive(Exception):
    """The results cannot decide a claim; the message says why."""


@dataclass(frozen=True)
class Claim(Generic[Evidence]):
    """A hypothesis.

    Attributes:
        id: short name, such as "C1".
        text: the hypothesis and its definition.
        predicate: from the evidence, whether it holds and the numbers behind that; raises `Inconclusive` if the
            evidence cannot decide.
    """

    id: str
    text: str
    predicate: Callable[[Evidence], tuple[bool, str]]


@dataclass(frozen=True)
class Verdict:
    """The outcome of a claim.

    Attributes:
        id, text: of the claim.
        holds: None if the results are inconclusive.
        measured: the numbers, or why they are inconclusive.
    """

    id: str
    text: str
    holds: bool | None
    measured: str


def evaluate(claims: Iterable[Claim[Evidence]], evidence: Evidence) -> list[Verdict]:
    """The verdict on each claim."""

    def one(claim: Claim[Evidence]) -> Verdict:
        try:
            holds, measured = claim.predicate(evidence)
        except Inconclusive as why:
            return Verdict(claim.id, claim.text, None, str(why))
        return Verdict(claim.id, claim.text, bool(holds), measured)

    return [one(claim) for claim in claims]


def verdict_table(verdicts: Sequence[Verdict], title: str) -> Table:
    """A line per claim."""
    lines = [(each.id, each.text, OUTCOMES[each.holds], each.measured) for each in verdicts]
    return Table(title, ("", "claim", "verdict", "measured"), lines)


def to_json(verdicts: Sequence[Verdict]) -> dict[str, list[dict[str, Any]]]:
    """The keys of report.json: `claims` that were decided, and `not_judged` for those that are inconclusive."""
    return {
        "claims": [vars(each) for each in verdicts if each.holds is not None],
        "not_judged": [{"id": v.id, "text": v.text, "why": v.measured} for v in verdicts if v.holds is None],
    }


def from_json(record: Mapping[str, Any]) -> list[Verdict]:
    """Read the keys of `to_json`, in the order of the claims' numbers.

    Raises:
        ValueError: an entry is malformed; names it.
    """
    found = [_verdict(f"claims[{i}]", item) for i, item in enumerate(record["claims"])]
    for index, item in enumerate(record.get("not_judged", [])):
        given = item if isinstance(item, dict) else {}
        undecided = {"id": given.get("id"), "text": given.get("text", ""), "holds": None, "measured": given.get("why")}
        found.append(_verdict(f"not_judged[{index}]", undecided))
    return sorted(found, key=lambda verdict: (len(verdict.id), verdict.id))


def _verdict(name: str, item: Any) -> Verdict:
    kinds = {"id": str, "text": str, "holds": bool | None, "measured": str}
    if not isinstance(item, dict) or item.keys() != kinds.keys():
        raise ValueError(f"{name}: a claim must be an object of id, text, holds, measured")
    if not all(isinstance(item[key], kind) for key, kind in kinds.items()):
        raise ValueError(f"{name}: holds must be true or false and the rest text")
    return Verdict(**item)
