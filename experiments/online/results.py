"""Rows, tables and claims of flights with a change in the air."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from experiments.flying.scenario import REFERENCES
from experiments.online.agents import AGENTS, CHANGE_NAMES, CHANGES, NAMES, PARTS, true_theta
from experiments.online.flights import Run
from experiments.reporting.claims import Claim, Part, Undecided, all_of
from experiments.reporting.results import Results, Row
from experiments.reporting.tables import EMPTY, Table, cross_table

CRASH, RATE = 10.0, 100  # m from the reference; periods in a second
SETTLED, LEARNED = 1.0, 3.0  # s after the change, from which errors and intervals are judged
FACTOR, WORSE, COVERED = 1.2, 1.02, 0.9
STEP_MS, MINUTES, FLIGHTS = 0.2, 5.0, 1440
Z = 1.959964
TAGS = ("change", "reference", "agent", "seed")


@dataclass(frozen=True)
class GoalEvidence:
    rows: Results
    step_ms: float  # processor time of one step of the filter on one core
    seconds: float | None  # of all flights, on the clock, without compiling
    processor_seconds: float | None  # likewise, on all cores


def results_of(run: Run) -> Results:
    """Return a row for each flight, with RMSE [m] of the first second after the change, and from SETTLED on."""
    rows = []
    for i, trial in enumerate(run.trials):
        error, low = run.after.error[i], run.after.altitude[i].min()
        crashed = not (np.isfinite(error).all() and error.max() <= CRASH and low >= 0)
        row: dict[str, Any] = {**trial._asdict(), "crashed": crashed, "largest": float(np.max(error))}
        row |= {name: rms(part) for name, part in (("first_second", error[:RATE]), ("settled", error[RATE:]))}
        if trial.agent == "online":
            row |= _intervals(run, i, trial.change)
        rows.append(row)
    return Results(rows, TAGS)


def rms(values: Any) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def _intervals(run: Run, i: int, change: str) -> Row:
    """Return the share of time from LEARNED on with the true value inside each interval; and when it alarmed."""
    late = slice(round(LEARNED * RATE), None)
    theta, std = run.after.theta[i][late, :PARTS], run.after.std[i][late, :PARTS]
    inside = np.abs(theta - true_theta(CHANGES[change])) <= Z * std
    alarms = np.flatnonzero(np.diff(run.after.changes[i], prepend=run.after.changes[i][:1]))
    shares = inside.mean(axis=0) if len(theta) else np.full(PARTS, np.nan)
    first = float(alarms[0]) / RATE if len(alarms) else None
    return {"inside": dict(zip(NAMES, shares.tolist(), strict=True)), "first_alarm": first, "alarms": len(alarms)}


def error(name: str):
    """Return an error in cm, infinite for a crash."""
    return lambda row: np.inf if row["crashed"] or row[name] is None else 100 * row[name]


def conclusion(rows: Results) -> list[str]:
    means = {
        key: np.mean(own.where(crashed=False).numbers(error("settled")))
        for key, own in rows.where(agent=("online", "oracle")).group("change", "agent").items()
    }
    ratios = [means[change, "online"] / means[change, "oracle"] for change, agent in means if agent == "online"]
    if not ratios or len(means) < 2 * len(ratios):
        return []
    span = f"{min(ratios):.2f} to {max(ratios):.2f} times"
    who = "a controller that knows the change"
    return [f"From {SETTLED:g} s after a change on, a controller that adapts flies {span} as far off as {who}."]


def tables(rows: Results) -> list[Table]:
    made = []
    columns = {REFERENCES[name]: {"reference": name} for name in rows.unique("reference")}
    for change, group in rows.group("change").items():
        lines = {AGENTS[agent]: own for agent, own in group.group("agent").items()}
        for title, name in ((f"from {SETTLED:g} s after it on", "settled"), ("in the first second", "first_second")):

            def cell(own: Results, name=name) -> str:
                crashes = sum(own["crashed"])
                text = f"{np.mean(own.numbers(error(name))):.2f}" if not crashes else f"{crashes} of {len(own)} crash"
                return text if len(own) else EMPTY

            title = f"RMSE of the position [cm], {CHANGE_NAMES[change]}, {title} (mean over seeds; less is better)"
            made.append(cross_table(title, lines, columns, cell))
    return [*made, *_found(rows), *_coverage(rows)]


def _found(rows: Results) -> list[Table]:
    lines = []
    for change, group in rows.where(agent="online").group("change").items():
        own = [CHANGE_NAMES[change]]
        for reference in rows.unique("reference"):
            flights = group.where(reference=reference)
            times = [t for t in flights["first_alarm"] if t is not None]
            own.append(f"{len(times)} of {len(flights)}" + (f", {1000 * np.median(times):.0f} ms" if times else ""))
        lines.append(tuple(own))
    header = ("change", *(REFERENCES[name] for name in rows.unique("reference")))
    title = "Flights in which the filter found a change, and the median time until then"
    return [Table(title, header, lines)] if lines else []


def _coverage(rows: Results) -> list[Table]:
    lines = []
    for change, own in rows.where(agent="online").group("change").items():
        inside = np.array([[row["inside"][name] for name in NAMES] for row in own], float).mean(axis=0)
        lines.append((CHANGE_NAMES[change], *(f"{100 * share:.0f}" for share in inside)))
    title = f"Share of 95 % intervals that contain the true value [%], from {LEARNED:g} s after the change on"
    return [Table(title, ("change", *NAMES), lines)] if lines else []


def _compared(e: GoalEvidence, change: str, other: str, factor: float) -> Iterator[Part]:
    """On each reference, whether online adaptation's error is at most a factor times another agent's."""
    for reference in e.rows.unique("reference"):
        own, others = (e.rows.where(change=change, agent=name, reference=reference) for name in ("online", other))
        if not len(own) or not len(others):
            raise Undecided(f"{AGENTS['online']} or {AGENTS[other]} did not fly")
        excess = own.interval(error("settled"), others, factor)
        ratio = np.mean(own.numbers(error("settled"))) / np.mean(others.numbers(error("settled")))
        text = f"{ratio:.2f} ×" if other == "oracle" else f"{100 * (ratio - 1):+.1f} %"
        yield excess.below(0), f"{REFERENCES[reference]}: {text}"


def _no_crash(e: GoalEvidence) -> Part:
    own, oracle = (e.rows.where(agent=agent).group("change", "reference", "seed") for agent in ("online", "oracle"))
    if not oracle or not own:
        raise Undecided("the oracle or the online adaptation did not fly")
    lost = {place for place, rows in oracle.items() if any(rows["crashed"])}
    crashes = sum(any(rows["crashed"]) and place not in lost for place, rows in own.items())
    return crashes == 0, f"{crashes} of {len(own)} flights, the oracle {len(lost)}"


def _holds_truth(e: GoalEvidence) -> Iterator[Part]:
    for change, own in e.rows.where(agent="online").group("change").items():
        shares = np.array([list(row["inside"].values()) for row in own], float).mean(axis=1)
        if not np.isfinite(shares).all():
            raise Undecided(f"flights end before {LEARNED:g} s after the change")
        margin = 1.96 * shares.std() / np.sqrt(len(shares))  # flights are independent, parameters of one are not
        holds = True if shares.mean() >= COVERED else False if shares.mean() + margin < COVERED else None
        yield holds, f"{CHANGE_NAMES[change]}: {shares.mean():.2f}"


def _fast_step(e: GoalEvidence) -> Part:
    return e.step_ms <= STEP_MS, f"{e.step_ms:.3f} ms"


def _fast_table(e: GoalEvidence) -> Part:
    if e.seconds is None or e.processor_seconds is None:
        raise Undecided("the time was not recorded")
    minutes, alone = (FLIGHTS / len(e.rows) * taken / 60 for taken in (e.seconds, e.processor_seconds))
    words = f"{minutes:.1f} minutes on the clock, {alone:.1f} of one core's time (from {len(e.rows)} flights)"
    return minutes <= MINUTES, words


_PAIRED = "on each reference (95 % interval of the paired difference over seeds)"
_NEAR = (
    f"from {SETTLED:g} s after it on the RMSE of online adaptation is at most {FACTOR:g} times the oracle's {_PAIRED}."
)
_WORSE = f"Without a change its RMSE is at most {WORSE - 1:.0%} above that of the unadapted model {_PAIRED}."
_COVERS = (
    f"From {LEARNED:g} s after the change on, at least {COVERED:.0%} of the 95 % intervals of its parameters contain "
    "the truth, after each change (fails: significantly fewer)."
)


def claims(changes: list[str]) -> list[Claim[GoalEvidence]]:
    def near(letter: str, change: str) -> Claim[GoalEvidence]:
        text = f"{CHANGE_NAMES[change]}: {_NEAR}"
        return Claim(f"O1{letter}", text, lambda e: all_of(_compared(e, change, "oracle", FACTOR)))

    return [
        *map(near, "abcdef", changes),
        Claim("O2", "No flight with online adaptation crashes where the oracle does not.", _no_crash),
        Claim("O3", _WORSE, lambda e: all_of(_compared(e, "nothing", "unadapted", WORSE))),
        Claim("O4", _COVERS, lambda e: all_of(_holds_truth(e))),
        Claim("O5", f"A step of the filter takes at most {STEP_MS:g} ms on one core.", _fast_step),
        Claim(
            "O6", f"{FLIGHTS} flights take at most {MINUTES:g} minutes on two cores (without compiling).", _fast_table
        ),
    ]
