"""Rows, tables and claims of flights with a change in the air."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from experiments.flying.scenario import REFERENCES
from experiments.online.agents import AGENTS, NAMES, PARTS, true_theta
from experiments.online.flights import Run
from experiments.reporting.claims import OUTCOMES, Claim, Part, Undecided, all_of, every
from experiments.reporting.names import label
from experiments.reporting.results import Results, Row
from experiments.reporting.tables import EMPTY, Cell, Table, cross_table, tabulate

CRASH, RATE = 10.0, 100  # m from the reference; periods in a second
SETTLED, LEARNED = 1.0, 3.0  # s after the change, from which errors and intervals are judged
FACTOR, WORSE, COVERED = 1.2, 1.02, 0.9
STEP_MS, MINUTES, FLIGHTS = 0.2, 5.0, 1440
Z = 1.959964
BESIDE = "unadapted", "online", "oracle"
TAGS = ("world", "change", "reference", "agent", "seed")


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
            row |= _intervals(run, i)
        rows.append(row)
    return Results(rows, TAGS)


def rms(values: Any) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def _intervals(run: Run, i: int) -> Row:
    """Return the share of time from LEARNED on with the true value inside each interval; and when it alarmed."""
    late = slice(round(LEARNED * RATE), None)
    theta, std = run.after.theta[i][late, :PARTS], run.after.std[i][late, :PARTS]
    inside = np.abs(theta - true_theta(run.trials[i].world, run.trials[i].change)) <= Z * std
    alarms = np.flatnonzero(np.diff(run.after.changes[i], prepend=run.after.changes[i][:1]))
    shares = inside.mean(axis=0) if len(theta) else np.full(PARTS, np.nan)
    first = float(alarms[0]) / RATE if len(alarms) else None
    return {"inside": dict(zip(NAMES, shares.tolist(), strict=True)), "first_alarm": first, "alarms": len(alarms)}


def error(name: str):
    """Return an error in cm, infinite for a crash."""
    return lambda row: np.inf if row["crashed"] or row[name] is None else 100 * row[name]


def means_of(rows: Results) -> dict[tuple[str, str, str], float]:
    """Return the mean error by world, change and agent [cm] from SETTLED on, infinite if a flight crashes."""
    groups = rows.group("world", "change", "agent")
    return {key: float(np.mean(own.numbers(error("settled")))) for key, own in groups.items()}


def conclusion(rows: Results) -> list[str]:
    means, spans = means_of(rows), []
    for world, own in rows.group("world").items():
        if not {"online", "oracle"} <= {*own["agent"]}:
            return []
        ratios = [means[world, change, "online"] / means[world, change, "oracle"] for change in own.unique("change")]
        spans.append(f"{min(ratios):.2f} to {max(ratios):.2f} times ({label(world)})".replace("inf", "∞"))
    who = "as far off as a controller that knows the change"
    return [f"From {SETTLED:g} s after a change on, a controller that adapts flies {', '.join(spans)} {who}."]


def tables(rows: Results) -> list[Table]:
    def cell(own: Results) -> str:
        if crashes := sum(own["crashed"]):
            return f"{crashes} of {len(own)} crash"
        settled, first = (np.mean(own.numbers(error(name))) for name in ("settled", "first_second"))
        return f"{settled:.2f} ({first:.2f})"

    made, columns = [_beside(rows)], {REFERENCES[name]: {"reference": name} for name in rows.unique("reference")}
    for (change, world), own in rows.group("change", "world").items():
        lines = {words: found for agent, words in AGENTS.items() if (found := own.where(agent=agent))}
        when = f"from {SETTLED:g} s after it on (in the first second; mean over seeds)"
        made.append(cross_table(f"{label(world)}: position RMSE [cm], {label(change)}, {when}", lines, columns, cell))
    online = rows.where(agent="online").group("world", "change")
    return made + ([_found(online, columns), _coverage(online)] if online else [])


def _beside(rows: Results) -> Table:
    """Return a line for each change: the errors of three agents in each world."""
    lines, worlds, means = [], rows.unique("world"), means_of(rows)
    for change in rows.unique("change"):
        found = ([means.get((world, change, agent)) for agent in BESIDE] for world in worlds)
        cells = (" / ".join(EMPTY if n is None else f"{n:.2f}".replace("inf", "∞") for n in each) for each in found)
        lines.append((label(change), *cells))
    who = " / ".join(AGENTS[name] for name in BESIDE)
    title = f"RMSE of the position [cm] from {SETTLED:g} s after a change on: {who} (mean; ∞: one crashes)"
    return Table(title, ("change", *map(label, worlds)), lines)


def _found(online: Mapping[Any, Results], columns: Mapping[str, Mapping[str, str]]) -> Table:
    def cell(own: Results) -> str:
        times = [t for t in own["first_alarm"] if t is not None]
        return f"{len(times)} of {len(own)}" + (f", {1000 * np.median(times):.0f} ms" if times else "")

    title = "Flights in which the filter found a change, and the median time until then"
    return cross_table(title, {label(*key): own for key, own in online.items()}, columns, cell, "world, change")


def _coverage(online: Mapping[Any, Results]) -> Table:
    share: dict[str, Cell] = {
        name: lambda own, name=name: f"{100 * own.numbers(lambda row: row['inside'][name], np.nan).mean():.0f}"
        for name in NAMES
    }
    title = f"Share of 95 % intervals that contain the true value [%], from {LEARNED:g} s after the change on"
    return tabulate(title, online, share, ("world", "change"))


def _in_each_world(e: GoalEvidence, judge: Callable[[Results], Part]) -> Part:
    """Judge each world, and all of them together."""
    parts = {label(world): judge(own) for world, own in e.rows.group("world").items()}
    measured = (f"{world} {OUTCOMES[holds]}: {text}" for world, (holds, text) in parts.items())
    return every(holds for holds, _ in parts.values()), " | ".join(measured)


def _compared(rows: Results, change: str, other: str, factor: float) -> Iterator[Part]:
    """On each reference, whether online adaptation's error is at most a factor times another agent's."""
    for reference in rows.unique("reference"):
        own, others = (rows.where(change=change, agent=name, reference=reference) for name in ("online", other))
        if not len(own) or not len(others):
            raise Undecided(f"{AGENTS['online']} or {AGENTS[other]} did not fly")
        excess = own.interval(error("settled"), others, factor)
        ratio = np.mean(own.numbers(error("settled"))) / np.mean(others.numbers(error("settled")))
        text = f"{ratio:.2f} ×" if other == "oracle" else f"{100 * (ratio - 1):+.1f} %"
        yield excess.below(0), f"{REFERENCES[reference]}: {text}"


def _no_crash(rows: Results) -> Part:
    own, oracle = (rows.where(agent=agent).group("change", "reference", "seed") for agent in ("online", "oracle"))
    if not oracle or not own:
        raise Undecided("the oracle or the online adaptation did not fly")
    lost = {place for place, rows in oracle.items() if any(rows["crashed"])}
    crashes = sum(any(rows["crashed"]) and place not in lost for place, rows in own.items())
    return crashes == 0, f"{crashes} of {len(own)} flights, the oracle {len(lost)}"


def _holds_truth(rows: Results) -> Iterator[Part]:
    for change, own in rows.where(agent="online").group("change").items():
        shares = np.array([list(row["inside"].values()) for row in own], float).mean(axis=1)
        if not np.isfinite(shares).all():
            raise Undecided(f"flights end before {LEARNED:g} s after the change")
        margin = 1.96 * shares.std() / np.sqrt(len(shares))  # flights are independent, parameters of one are not
        holds = True if shares.mean() >= COVERED else False if shares.mean() + margin < COVERED else None
        yield holds, f"{label(change)}: {shares.mean():.2f}"


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
    def of(id: str, text: str, judge: Callable[[Results], Part]) -> Claim[GoalEvidence]:
        return Claim(id, f"In each world: {text}", lambda e: _in_each_world(e, judge))

    def near(letter: str, change: str) -> Claim[GoalEvidence]:
        text = f"{label(change)}: {_NEAR}"
        return of(f"O1{letter}", text, lambda rows: all_of(_compared(rows, change, "oracle", FACTOR)))

    return [
        *map(near, "abcdef", changes),
        of("O2", "No flight with online adaptation crashes where the oracle does not.", _no_crash),
        of("O3", _WORSE, lambda rows: all_of(_compared(rows, "nothing", "unadapted", WORSE))),
        of("O4", _COVERS, lambda rows: all_of(_holds_truth(rows))),
        Claim("O5", f"A step of the filter takes at most {STEP_MS:g} ms on one core.", _fast_step),
        Claim(
            "O6", f"{FLIGHTS} flights take at most {MINUTES:g} minutes on two cores (without compiling).", _fast_table
        ),
    ]
