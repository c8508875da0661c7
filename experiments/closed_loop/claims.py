"""What closed-loop flight was to reach, each goal judged on the rows by a definition that its own text states."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from experiments.closed_loop.rows import LEARNED, REFERENCES, SOURCES, UNCHANGED, Cells, FlightRow, Flyer, cells
from experiments.closed_loop.tables import ORACLE, gaps
from experiments.paper.claims import Claim
from experiments.reporting.paired import mean_difference

SHIFT, WIND = "parameter_shift", "external_force"
THREE = ("hover", "figure_eight", "low_pass")
FACTOR, SHARE, KEPT, ALIKE = 4.0, 0.9, 0.1, 1.1
DECIMALS = 6  # of a cm; flights in single precision tell no more
RESOLUTION = float(np.spacing(np.float32(1.0)))  # m; of positions between 1 and 2 m, where most is flown
STEP_MS, LANES_MINUTES, LANES, LANE_SECONDS = 1.5, 3.0, 360, 10.0


class _NotJudged(Exception):
    """Why what was flown cannot judge a goal."""


@dataclass(frozen=True)
class Speed:
    """How fast it was.

    Attributes:
        call_ms: processor time of one call of the controller with the adapted hybrid [ms].
        median_ms: time on the clock of one [ms].
        lane_seconds: seconds flown in all lanes together.
        seconds: that took.
        processor_seconds: on all cores.
        devices: that flew.
    """

    call_ms: float
    median_ms: float
    lane_seconds: float
    seconds: float
    processor_seconds: float
    devices: int


@dataclass(frozen=True)
class _Evidence:
    found: Cells
    model: str
    few: int

    def mean(self, domain: str, reference: str, flyer: Flyer, distance: float = 0.0) -> float:
        """The mean position RMSE [cm] over seeds; infinite if one crashed."""
        return 100 * float(np.mean([row.error for row in self.group(domain, reference, flyer, distance)]))

    def group(self, domain: str, reference: str, flyer: Flyer, distance: float = 0.0) -> list[FlightRow]:
        rows = self.found.get((domain, reference, distance), {}).get(flyer)
        if not rows:
            away = f", {distance:g} m away" if distance else ""
            raise _NotJudged(f"there are no flights of {flyer.name}, {domain}, {REFERENCES[reference]}{away}")
        return rows

    @property
    def source(self) -> Flyer:
        return Flyer(SOURCES[self.model])

    @property
    def adapted(self) -> Flyer:
        return Flyer(self.model, self.few)

    @property
    def observed(self) -> tuple[Flyer, Flyer]:
        """The source model and the adapted one, each with the observer."""
        return replace(self.source, observer=True), replace(self.adapted, observer=True)


def claims(rows: Sequence[FlightRow], few: int, speed: Speed | None) -> list[Claim]:
    """Judge what was to be reached, for the paper's network and for both ways to adapt the safe one.

    Args:
        few: the N with which the adapted models were trained.
    """
    found = cells(rows)
    made = []
    for number, text, judge in _RULES:
        for letter, model in zip("abc", SOURCES, strict=True):
            evidence = _Evidence(found, model, few)
            words = f"{LEARNED[model]}: {text}"
            made.append(_judged(f"R{number}{letter}", words, lambda e=evidence, j=judge: j(e)))
    made += [_judged(name, text, lambda j=judge: j(speed)) for name, text, judge in _SPEED_RULES]
    return sorted(made, key=lambda claim: claim.id)


def _judged(name: str, text: str, judge: Callable[[], tuple[bool, str]]) -> Claim:
    try:
        holds, measured = judge()
    except _NotJudged as why:
        return Claim(name, text, None, str(why))
    return Claim(name, text, bool(holds), measured)


def _smaller_in_wind(e: _Evidence) -> tuple[bool, str]:
    means = {reference: [e.mean(WIND, reference, flyer) for flyer in (e.source, e.adapted)] for reference in THREE}
    words = [
        f"{REFERENCES[reference]}: {' → '.join(_cm(source, adapted))} ({source / adapted:.2f} ×)"
        for reference, (source, adapted) in means.items()
    ]
    return all(source >= FACTOR * adapted for source, adapted in means.values()), "; ".join(words)


def _closes_the_gap(e: _Evidence) -> tuple[bool, str]:
    for reference in THREE:
        for flyer in (e.source, e.adapted, ORACLE):
            e.group(WIND, reference, flyer)
    shares = gaps(e.found, WIND)[e.adapted]
    words = [
        f"{REFERENCES[r]}: {100 * s.value:.1f} % ({100 * s.low:.1f} … {100 * s.high:.1f})"
        for r, s in shares.items()
        if r in THREE
    ]
    whole = all(math.isfinite(row.error) for r in THREE for row in e.group(WIND, r, e.adapted))
    return whole and all(shares[reference].value >= SHARE for reference in THREE), "; ".join(words)


def _none_worse(e: _Evidence, before: Flyer, after: Flyer) -> tuple[bool, str]:
    words, verdicts = [], []
    for reference in _flown(e, SHIFT):
        source, adapted = (e.group(SHIFT, reference, flyer) for flyer in (before, after))
        apart = mean_difference([row.error for row in adapted], [row.error for row in source])
        means = [100 * float(np.mean([row.error for row in rows])) for rows in (source, adapted)]
        sure = "" if math.isnan(apart.low) or apart.low <= 0 <= apart.high else ", surely"
        remark = ", equal" if _equal(*means) else sure
        words.append(f"{REFERENCES[reference]}: {' → '.join(_cm(*means))}{remark}")
        verdicts.append(means[1] <= means[0] or _equal(*means))
    return all(verdicts), "; ".join(words)


def _promise_kept(e: _Evidence) -> tuple[bool, str]:
    def excess(domain: str, reference: str, flyer: Flyer) -> float:
        return 100 * float(np.mean([row.number("excess") for row in e.group(domain, reference, flyer)]))

    words, verdicts = [], []
    for reference in _flown(e, SHIFT):
        value, beside = excess(SHIFT, reference, e.adapted), f"source {excess(SHIFT, reference, e.source):+.0f} %"
        if e.source in e.found.get((UNCHANGED, reference, 0.0), {}):
            beside += f", before the change {excess(UNCHANGED, reference, e.source):+.0f} %"
        words.append(f"{REFERENCES[reference]}: {value:+.1f} % ({beside})")
        verdicts.append(abs(value) <= 100 * KEPT)
    return all(verdicts), "; ".join(words)


def _observer_adds(e: _Evidence) -> tuple[bool, str]:
    alone, both = e.observed
    words, verdicts = [], []
    for domain in (SHIFT, WIND):
        for reference in THREE:
            means = [e.mean(domain, reference, flyer) for flyer in (e.adapted, alone, both)]
            adapted, observed, together = _cm(*means)
            where = f"{domain.replace('_', ' ')}, {REFERENCES[reference]}"
            best = min(means[:2])
            tie = _equal(means[2], best)
            words.append(f"{where}: {adapted}, {observed} → {together}{', equal' if tie else ''}")
            verdicts.append(means[2] < best and not tie)
    return all(verdicts), "adapted, observer → both: " + "; ".join(words)


def _knows_no_place(e: _Evidence) -> tuple[bool, str]:
    words, verdicts = [], []
    away = [cell for cell in e.found if cell[2] and e.adapted in e.found[cell]]
    if not away:
        raise _NotJudged("nothing was flown away from home")
    for domain, reference, distance in away:
        here, there = (e.mean(domain, reference, e.adapted, d) for d in (0.0, distance))
        words.append(f"{domain.replace('_', ' ')}, {REFERENCES[reference]}: {' → '.join(_cm(here, there))}")
        verdicts.append(there <= ALIKE * here)
    return all(verdicts), "; ".join(words)


def _fast_enough(speed: Speed | None) -> tuple[bool, str]:
    if speed is None:
        raise _NotJudged("it was not timed")
    words = f"{speed.call_ms:.2f} ms of processor time, {speed.median_ms:.2f} ms on the clock (median)"
    return speed.call_ms <= STEP_MS, words


def _flown_in_time(speed: Speed | None) -> tuple[bool, str]:
    if speed is None:
        raise _NotJudged("it was not timed")
    minutes = LANES * LANE_SECONDS / speed.lane_seconds * speed.seconds / 60
    alone = LANES * LANE_SECONDS / speed.lane_seconds * speed.processor_seconds / speed.devices / 60
    words = f"{minutes:.1f} minutes on {speed.devices} devices, {alone:.1f} if they did nothing else"
    return minutes <= LANES_MINUTES, words


def _flown(e: _Evidence, domain: str) -> list[str]:
    flown = [reference for reference in REFERENCES if e.adapted in e.found.get((domain, reference, 0.0), {})]
    if not flown:
        raise _NotJudged(f"there are no flights of {e.adapted.name}, {domain}")
    return flown


def _equal(one: float, other: float) -> bool:
    """Whether two errors [cm] differ by no more than rounding."""
    return abs(one - other) <= 100 * RESOLUTION


def _cm(*means: float) -> list[str]:
    """In cm, by as few decimals as tell apart those that differ: two, or up to DECIMALS."""
    apart = len(set(means))
    for decimals in range(2, DECIMALS + 1):
        told = [f"{mean:.{decimals}f} cm" if math.isfinite(mean) else "∞ (a crash)" for mean in means]
        if len(set(told)) == apart:
            break
    return told


_THREE = ", ".join(REFERENCES[reference] for reference in THREE)
_EQUAL = f"equal: within {1e6 * RESOLUTION:.2f} µm, the rounding of single precision"
_RULES: Sequence[tuple[int, str, Callable[[_Evidence], tuple[bool, str]]]] = (
    (
        1,
        f"in the wind the mean RMSE of the source model is at least {FACTOR:g} times that of the model adapted with "
        f"the smallest N, on each of {_THREE}.",
        _smaller_in_wind,
    ),
    (
        2,
        f"in the wind adaptation with the smallest N closes at least {SHARE:.0%} of the gap between the source model's "
        f"RMSE and that of the true vehicle in the mean wind, on each of {_THREE} (ratio of means over the "
        "seeds that did not crash, which must be all; beside it the 95 % interval).",
        _closes_the_gap,
    ),
    (
        3,
        "under the parameter shift the mean RMSE after adaptation with the smallest N is not above that of the source "
        f"model on any reference (surely: the 95 % interval of the paired difference excludes 0; {_EQUAL}).",
        lambda e: _none_worse(e, e.source, e.adapted),
    ),
    (
        4,
        f"under the parameter shift, adapted with the smallest N, the realised cost of plans is within {KEPT:.0%} of "
        "the promised one on every reference (mean over seeds; of calls every 0.5 s, summed; a promise below 5 mm "
        "throughout counts as that; beside it the source model, after the change and on the vehicle that it learned).",
        _promise_kept,
    ),
    (
        5,
        "adaptation with the smallest N and observer together have a smaller mean RMSE than either alone (the observer "
        f"on the source model), under both shifts and on each of {_THREE} ({_EQUAL}).",
        _observer_adds,
    ),
    (
        6,
        f"adapted with the smallest N it flies as well far from home: the mean RMSE there is at most {ALIKE:g} times "
        "that at home, on all that was flown.",
        _knows_no_place,
    ),
    (
        9,
        "with the observer before and after, under the parameter shift, the mean RMSE after adaptation with the "
        "smallest N is not above that of the source model on any reference (surely: the 95 % interval of the paired "
        f"difference excludes 0; {_EQUAL}).",
        lambda e: _none_worse(e, *e.observed),
    ),
)
_SPEED_RULES: Sequence[tuple[str, str, Callable[[Any], tuple[bool, str]]]] = (
    (
        "R7",
        f"A call of the controller with the adapted hybrid takes at most {STEP_MS:g} ms on one core (processor time).",
        _fast_enough,
    ),
    (
        "R8",
        f"{LANES} flights of {LANE_SECONDS:g} s take at most {LANES_MINUTES:g} minutes (without compiling).",
        _flown_in_time,
    ),
)
