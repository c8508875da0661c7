"""Hypotheses about closed-loop flight, as data."""

import math
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace
from functools import partial
from itertools import product
from typing import Any, NamedTuple

import numpy as np

from experiments.closed_loop.config import THREE
from experiments.closed_loop.results import LEARNED, ORACLE, SOURCES, Agent, away, gaps, uncrashed
from experiments.flying.scenario import REFERENCES
from experiments.reporting.claims import Claim, Part, Undecided, all_of, every
from experiments.reporting.names import EXTERNAL_FORCE, LABELS, PARAMETER_SHIFT, UNCHANGED
from experiments.reporting.results import Results
from experiments.reporting.statistics import Estimate

RMSE = uncrashed("position_rmse", 100.0)  # cm
WIND_FACTOR, GAP_SHARE, COST_TOLERANCE, AWAY_FACTOR = 4.0, 0.9, 0.1, 1.1
DECIMALS = 6  # of a cm; more are below single precision
RESOLUTION = float(np.spacing(np.float32(1.0)))  # m; of positions between 1 and 2 m, where most flights are
CALL_MS, FLIGHT_MINUTES, FLIGHTS, FLIGHT_SECONDS = 1.5, 3.0, 360, 10.0


class Speed(NamedTuple):
    call_ms: float  # processor time of one call
    median_ms: float  # wall-clock time of one call
    flown_seconds: float  # simulated, of all flights together
    seconds: float  # wall-clock time of all flights
    processor_seconds: float  # of all flights, on all cores
    devices: int


@dataclass(frozen=True)
class FlightEvidence:
    """All rows, and the speed."""

    rows: Results
    speed: Speed | None = None

    def group(self, agent: Agent, domain: str, reference: str | None = None, distance: float = 0.0) -> Results:
        place = {} if reference is None else {"reference": reference}
        rows = self.rows.where(domain=domain, distance=distance, **place, **asdict(agent))
        if not len(rows):
            where = domain if reference is None else f"{domain}, {REFERENCES[reference]}{away(distance)}"
            raise Undecided(f"there are no flights of {agent.name}, {where}")
        return rows

    def errors(self, *place: Any) -> np.ndarray:
        """Return the position RMSE [cm] of each seed of a `group`; infinite for a crash."""
        return self.group(*place).numbers(RMSE)

    def difference(self, first: tuple[Any, ...], second: tuple[Any, ...], times: float = 1.0) -> Estimate:
        """Return the mean RMSE [cm] of the first `group` minus `times` the second's, paired by seed."""
        return self.group(*first).interval(RMSE, self.group(*second), times)

    def clock(self) -> Speed:
        if self.speed is None:
            raise Undecided("the time was not recorded")
        return self.speed

    def references(self, agent: Agent) -> list[str]:
        own = self.group(agent, PARAMETER_SHIFT)["reference"]
        return [name for name in REFERENCES if name in own]


def claims(few: int) -> list[Claim[FlightEvidence]]:
    made: list[Claim[FlightEvidence]] = [Claim(id, text, lambda e, f=of: f(e.clock())) for id, text, of in SPEED_CLAIMS]
    for (number, text, parts), (letter, model) in product(CLAIMS, zip("abc", SOURCES, strict=True)):
        own = partial(parts, Agent(SOURCES[model]), Agent(model, few))
        made.append(Claim(f"R{number}{letter}", f"{LEARNED[model]}: {text}", lambda e, own=own: all_of(own(e))))
    return sorted(made, key=lambda claim: claim.id)


def _smaller_in_wind(source: Agent, adapted: Agent, e: FlightEvidence) -> Iterator[Part]:
    for reference in THREE:
        before, after = (e.errors(agent, EXTERNAL_FORCE, reference).mean() for agent in (source, adapted))
        new, old = ((agent, EXTERNAL_FORCE, reference) for agent in (adapted, source))
        excess = e.difference(new, old, 1 / WIND_FACTOR)
        words = f"{REFERENCES[reference]}: {' → '.join(_cm(before, after))} ({before / after:.2f} ×)"
        yield excess.below(0), f"{words}, after − before / {WIND_FACTOR:g}: {excess.text('.2g')}"


def _closes_the_gap(source: Agent, adapted: Agent, e: FlightEvidence) -> Iterator[Part]:
    for reference in THREE:
        _, errors, _ = (e.errors(agent, EXTERNAL_FORCE, reference) for agent in (source, adapted, ORACLE))
        share = gaps(e.rows.where(reference=reference), EXTERNAL_FORCE)[adapted][reference]
        value, low, high = (100 * number for number in share)
        # The seeds that crashed are not in the share.
        closed = share.above(GAP_SHARE) if np.isfinite(errors).all() else False
        yield closed, f"{REFERENCES[reference]}: {value:.1f} % ({low:.1f} … {high:.1f})"


def _none_worse(source: Agent, adapted: Agent, e: FlightEvidence) -> Iterator[Part]:
    for reference in e.references(adapted):
        new, old = ((agent, PARAMETER_SHIFT, reference) for agent in (adapted, source))
        after, before, change = e.errors(*new).mean(), e.errors(*old).mean(), e.difference(new, old)
        equal = _equal(before, after)
        remark = "equal" if equal else f"difference {change.text('.2g')}"
        yield equal or change.below(0), f"{REFERENCES[reference]}: {' → '.join(_cm(before, after))}, {remark}"


def _cost_predicted(source: Agent, adapted: Agent, e: FlightEvidence) -> Iterator[Part]:
    def error(*place: Any) -> Estimate:
        return e.group(*place).interval(uncrashed("excess", 100.0))

    for reference in e.references(adapted):
        value = error(adapted, PARAMETER_SHIFT, reference)
        others = f"source {error(source, PARAMETER_SHIFT, reference).value:+.0f} %"
        if len(e.rows.where(domain=UNCHANGED, reference=reference, **asdict(source))):
            others += f", before the change {error(source, UNCHANGED, reference).value:+.0f} %"
        within = every([value.below(100 * COST_TOLERANCE), value.above(-100 * COST_TOLERANCE)])
        yield within, f"{REFERENCES[reference]}: {value.text('+.1f')} % ({others})"


def _observer_adds(source: Agent, adapted: Agent, e: FlightEvidence) -> Iterator[Part]:
    agents = adapted, replace(source, observer=True), replace(adapted, observer=True)
    for place in product((PARAMETER_SHIFT, EXTERNAL_FORCE), THREE):
        *single, both = (e.errors(agent, *place).mean() for agent in agents)
        changes = [e.difference((agents[2], *place), (agent, *place)) for agent in agents[:2]]
        texts, equal = _cm(*single, both), _equal(both, min(single))
        remark = "equal" if equal else f"differences {', '.join(change.text('.2g') for change in changes)}"
        words = f"adapted {texts[0]}, observer {texts[1]} → both {texts[2]}, {remark}"
        smaller = False if equal else every(change.below(0) for change in changes)
        yield smaller, f"{LABELS[place[0]]}, {REFERENCES[place[1]]}: {words}"


def _same_away(source: Agent, adapted: Agent, e: FlightEvidence) -> Iterator[Part]:
    places = e.rows.where(lambda row: row["distance"] > 0, **asdict(adapted)).group("domain", "reference", "distance")
    if not places:
        raise Undecided("nothing was flown away from home")
    for domain, reference, distance in places:
        home, there = ((adapted, domain, reference, d) for d in (0.0, distance))
        excess, means = e.difference(there, home, AWAY_FACTOR), (e.errors(*place).mean() for place in (home, there))
        words = f"{LABELS[domain]}, {REFERENCES[reference]}: {' → '.join(_cm(*means))}"
        yield excess.below(0), f"{words}, away − {AWAY_FACTOR:g} × home: {excess.text('.2g')}"


def _fast_call(speed: Speed) -> Part:
    words = f"{speed.call_ms:.2f} ms of processor time, {speed.median_ms:.2f} ms on the clock (median)"
    return speed.call_ms <= CALL_MS, words


def _fast_flights(speed: Speed) -> Part:
    share = FLIGHTS * FLIGHT_SECONDS / speed.flown_seconds / 60
    minutes, alone = share * speed.seconds, share * speed.processor_seconds / speed.devices
    words = f"{minutes:.1f} minutes on {speed.devices} devices, {alone:.1f} if they did nothing else"
    return minutes <= FLIGHT_MINUTES, words


def _equal(one: float, other: float) -> bool:
    return abs(one - other) <= 100 * RESOLUTION


def _cm(*means: float) -> list[str]:
    """Format errors in cm, with as few decimals as distinguish different ones: two, or up to DECIMALS."""
    texts: list[str] = []
    for decimals in range(2, DECIMALS + 1):
        texts = [f"{mean:.{decimals}f} cm" if math.isfinite(mean) else "∞ (a crash)" for mean in means]
        if len(set(texts)) == len(set(means)):
            break
    return texts


_THREE = ", ".join(REFERENCES[reference] for reference in THREE)
_EQUAL = f"equal: within {1e6 * RESOLUTION:.2f} µm, the rounding of single precision"
_PAIRED = "95 % interval of the paired difference over seeds"
CLAIMS: list[tuple[int, str, Callable[[Agent, Agent, FlightEvidence], Iterator[Part]]]] = [
    (1, f"in the wind the mean RMSE of the source model is at least {WIND_FACTOR:g} times that of the model adapted "
        f"with the smallest N, on each of {_THREE} ({_PAIRED} [cm]).", _smaller_in_wind),
    (2, f"in the wind adaptation with the smallest N closes at least {GAP_SHARE:.0%} of the gap between the source "
        f"model's RMSE and that of the true vehicle in the mean wind, on each of {_THREE}, and no seed crashes (ratio "
        "of means over seeds; Fieller's 95 % interval).", _closes_the_gap),
    (3, "with the other inertia the mean RMSE after adaptation with the smallest N is not above that of the source "
        f"model on any reference ({_PAIRED}; {_EQUAL}).", _none_worse),
    (4, "with the other inertia, adapted with the smallest N, the actual open-loop cost of plans is within "
        f"{COST_TOLERANCE:.0%} of the predicted one on every reference (95 % interval of the mean over seeds; sum over "
        "calls every 0.5 s; the denominator is at least the cost of an offset of 5 mm; for comparison the source "
        "model, after the change and on the unchanged vehicle).", _cost_predicted),
    (5, "adaptation with the smallest N and observer together have a smaller mean RMSE than either alone (the observer "
        f"on the source model), under both changes and on each of {_THREE} ({_PAIRED}; {_EQUAL}).", _observer_adds),
    (6, f"adapted with the smallest N, the mean RMSE away from home is at most {AWAY_FACTOR:g} times that at home, in "
        f"each domain and on each reference flown there ({_PAIRED} [cm]).", _same_away),
    (9, "with the observer before and after, with the other inertia, the mean RMSE after adaptation with the "
        f"smallest N is not above that of the source model on any reference ({_PAIRED}; {_EQUAL}).",
     lambda source, adapted, e: _none_worse(replace(source, observer=True), replace(adapted, observer=True), e)),
]  # fmt: skip
SPEED_CLAIMS: list[tuple[str, str, Callable[[Speed], Part]]] = [
    ("R7", f"A call of the controller with the adapted hybrid takes at most {CALL_MS:g} ms on one core (processor "
           "time).", _fast_call),
    ("R8", f"{FLIGHTS} flights of {FLIGHT_SECONDS:g} s take at most {FLIGHT_MINUTES:g} minutes (without compiling).",
           _fast_flights),
]  # fmt: skip
