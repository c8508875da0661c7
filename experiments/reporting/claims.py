"""Hypotheses about results as data, evaluated to true, false or undecided, with the numbers behind it."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Generic, TypeVar

from experiments.reporting.tables import Table

Evidence = TypeVar("Evidence")
Part = tuple[bool | None, str]  # whether a hypothesis holds in one case, None if undecided, and the numbers behind that
SUMMED = {False: ("fail", "fails"), None: ("undecided", "undecided")}  # of several hypotheses, and of one
OUTCOMES = {True: "✓ holds", False: "✗ fails", None: "– undecided"}


class Undecided(Exception):
    """The results lack data for a claim; the message says which."""


@dataclass(frozen=True)
class Claim(Generic[Evidence]):
    """A hypothesis, and a function that decides it or raises `Undecided`."""

    id: str  # such as "C1"
    text: str
    predicate: Callable[[Evidence], Part]


@dataclass(frozen=True)
class Verdict:
    """The outcome of a claim: `holds` is None if it is undecided; `measured` says why, or which data are missing."""

    id: str
    text: str
    holds: bool | None
    measured: str
    lacks_data: bool = False


def every(outcomes: Iterable[bool | None]) -> bool | None:
    """False if one is, else None if one is, else True."""
    found = set(outcomes)
    return False if False in found else None if None in found else True


def all_of(parts: Iterable[Part]) -> Part:
    """Whether all parts of a hypothesis are true, see `every`, and their numbers."""
    holds, measured = zip(*parts, strict=True)
    return every(holds), "; ".join(measured)


def evaluate(claims: Iterable[Claim[Evidence]], evidence: Evidence) -> list[Verdict]:

    def verdict(claim: Claim[Evidence]) -> Verdict:
        try:
            holds, measured = claim.predicate(evidence)
            return Verdict(claim.id, claim.text, None if holds is None else bool(holds), measured)
        except Undecided as why:
            return Verdict(claim.id, claim.text, None, str(why), lacks_data=True)

    return [verdict(claim) for claim in claims]


def with_recorded(verdicts: Sequence[Verdict], record: Mapping[str, Any]) -> list[Verdict]:
    """Replace verdicts that lack data, such as times that were not kept, by those that the record has."""
    known = {each["id"]: each for each in record.get("claims", ())}
    return [
        replace(each, holds=known[each.id]["holds"], measured=known[each.id]["measured"], lacks_data=False)
        if each.lacks_data and each.id in known
        else each
        for each in verdicts
    ]


def verdict_table(verdicts: Sequence[Verdict], title: str) -> Table:
    lines = [(each.id, each.text, OUTCOMES[each.holds], each.measured) for each in verdicts]
    return Table(title, ("", "claim", "verdict", "measured"), lines, verdicts=True)


def summary(verdicts: Sequence[Verdict]) -> list[str]:
    judged = [each for each in verdicts if not each.lacks_data]
    if not judged:
        return []
    counts = {words: sum(each.holds is holds for each in judged) for holds, words in SUMMED.items()}
    others = [f"{count} {words[count == 1]}" for words, count in counts.items() if count]
    return [f"{sum(each.holds is True for each in judged)} of {len(judged)} hypotheses hold{', '.join(['', *others])}."]


def to_json(verdicts: Sequence[Verdict]) -> dict[str, list[dict[str, Any]]]:
    """Return the keys of report.json: `claims` with their outcome, and `not_judged` for those that lack data."""
    return {
        "claims": [
            {"id": v.id, "text": v.text, "holds": v.holds, "measured": v.measured} for v in verdicts if not v.lacks_data
        ],
        "not_judged": [{"id": v.id, "text": v.text, "why": v.measured} for v in verdicts if v.lacks_data],
    }
