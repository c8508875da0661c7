"""Results of closed-loop flight: tags, labels, agents, and tables with a line per agent."""

import math
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, fields
from typing import Any

import numpy as np

from experiments.flying.scenario import REFERENCES
from experiments.reporting.names import EXTERNAL_FORCE, LABELS, PARAMETER_SHIFT, UNCHANGED
from experiments.reporting.results import Results, Row
from experiments.reporting.statistics import Estimate, share_of_gap
from experiments.reporting.tables import EMPTY, Cell, Table, cross_table, mean_over_seeds, spread_text

DOMAINS = {name: LABELS[name] for name in (UNCHANGED, PARAMETER_SHIFT, EXTERNAL_FORCE)}
LEARNED = {
    "physics": "physics",
    "hybrid": "hybrid",
    "no_physics": "no-physics",
    "invariant": "invariant hybrid",
    "least_squares": "invariant, least squares",
}
SOURCES = {"hybrid": "hybrid", "invariant": "invariant", "least_squares": "invariant"}  # adapted → source model
KNOWN = {"nominal": "nominal physics", "oracle": "true vehicle, mean wind"}


@dataclass(frozen=True, order=True)
class Agent:
    """A controller with its prediction model."""

    model: str  # a key of KNOWN or LEARNED
    n_train: int = 0  # target trajectories for adaptation; 0 for a source model
    observer: bool = False  # with a disturbance observer

    @property
    def name(self) -> str:
        size = f"N = {self.n_train}" if self.n_train else "source"
        name = KNOWN[self.model] if self.model in KNOWN else f"{LEARNED[self.model]}, {size}"
        return name + (" + observer" if self.observer else "")


ORACLE = Agent("oracle")
TAGS = ("domain", *(field.name for field in fields(Agent)), "reference", "distance", "seed")
# Tracking performance in m, rad, m, and the share of saturated inputs; the mean predicted and actual open-loop cost of
# plans, and their relative error. The last three keep their names of earlier reports.
NUMBERS = ("position_rmse", "yaw_rmse", "largest_error", "saturation", "promised", "realised", "excess")


def uncrashed(column: str, factor: float = 1.0) -> Callable[[Row], float]:
    """Return one of NUMBERS times a factor; infinite for a crash or a value that is not finite."""
    return lambda row: math.inf if row["crashed"] or row[column] is None else factor * row[column]


ERROR = uncrashed("position_rmse")


def by_agent(rows: Results) -> dict[Agent, Results]:
    return {Agent(*key): group for key, group in rows.group(*asdict(ORACLE)).items()}


def away(distance: float) -> str:
    return f", {distance:g} m away" if distance else ""


def conclusion(rows: Results, few: int) -> list[str]:
    sentences = []
    for domain in (EXTERNAL_FORCE, PARAMETER_SHIFT):
        flown = {agent: _at_home(own) for agent, own in by_agent(rows.where(domain=domain, distance=0.0)).items()}
        parts, best = [], flown.get(ORACLE)
        for model, source in SOURCES.items():
            before, after = flown.get(Agent(source)), flown.get(Agent(model, few))
            if before is not None and after is not None:
                both = flown.get(Agent(model, few, observer=True))
                more = "" if both is None else f", with an observer {_in_cm(both)}"
                parts.append(f"{LEARNED[model]}: {_in_cm(before)} before, {_in_cm(after)} after{more}")
        if parts:
            known = "" if best is None else f"; the {KNOWN['oracle']} {_in_cm(best)}"
            what = f"{DOMAINS[domain].capitalize()}, adapted to {few} trajectories, median position RMSE at home"
            sentences.append(f"{what}: {'; '.join(parts)}{known}.")
        before, after = flown.get(Agent("invariant")), flown.get(Agent("invariant", few))
        if domain == EXTERNAL_FORCE and before is not None and after is not None:
            told = f"{DOMAINS[domain].capitalize()}: adapted to {few} trajectories, the {LEARNED['invariant']} has a"
            known = f"; the true vehicle has {_in_cm(best)}" if best is not None else ""
            found = f"{_in_cm(after)} at home instead of {_in_cm(before)}"
            sentences.insert(0, f"{told} median position RMSE of {found}{known}.")
    lost = {
        agent.name: f"{sum(own['crashed'])} of {len(own)}"
        for agent, own in by_agent(rows.where(lambda row: row["distance"] > 0)).items()
        if agent.n_train == few and agent.model in SOURCES and any(own["crashed"])
    }
    if lost:
        sentences.append(f"Away from home crash: {'; '.join(f'{name}: {count}' for name, count in lost.items())}.")
    return sentences


def _at_home(rows: Results) -> float:
    """Return the median over references and seeds, infinite if half of them crash."""
    return float(np.median(rows.numbers(ERROR)))


def _in_cm(error: float) -> str:
    return f"{100 * error:.2g} cm" if math.isfinite(error) else "a crash"


def main_table(rows: Results, few: int) -> list[Table]:
    """Return the position error in the wind of the source, of what adapts with few trajectories, and of the truth."""
    adapted = [Agent(model, few, observer) for observer in (False, True) for model in ("invariant", "least_squares")]
    shown = [Agent("invariant"), Agent("hybrid", few), *adapted, Agent("invariant", observer=True), ORACLE]
    flown = by_agent(rows.where(domain=EXTERNAL_FORCE, distance=0.0))
    lines = {agent.name: flown[agent] for agent in shown if agent in flown}
    columns = {label: {"reference": name} for name, label in REFERENCES.items() if name in rows.unique("reference")}
    title = f"Position RMSE [cm], side wind ({mean_over_seeds(rows)}; less is better)"
    return [cross_table(title, lines, columns, number_text("position_rmse", 100.0, ".2f"))] if lines else []


def tables(rows: Results) -> list[Table]:
    seeds = mean_over_seeds(rows)
    titles: dict[str, Cell] = {
        f"Position RMSE [cm] ({seeds}; less is better)": number_text("position_rmse", 100.0, ".2f"),
        f"Largest position error [cm] ({seeds})": number_text("largest_error", 100.0, ".1f"),
        f"Yaw RMSE [°] ({seeds})": number_text("yaw_rmse", 180 / math.pi, ".2f"),
        "Crashes; share of rotor speeds at a limit [%]": crash_text,
        f"Predicted open-loop cost of a plan, and its relative error [%] ({seeds})": cost_text,
    }
    made = []
    for (domain, distance), group in rows.sort(domain=list(DOMAINS), distance=None).group("domain", "distance").items():
        lines = {agent.name: own for agent, own in by_agent(group).items()}
        columns = {label: {"reference": name} for name, label in REFERENCES.items() if name in group["reference"]}
        for title, text in list(titles.items())[: 1 if distance else None]:
            made.append(cross_table(f"{title}, {DOMAINS[domain]}{away(distance)}", lines, columns, text))
    return made


def gap_tables(rows: Results) -> list[Table]:
    made = []
    for domain in DOMAINS:
        shares = gaps(rows, domain)
        columns = [name for name in REFERENCES if any(name in line for line in shares.values())]
        lines = [(agent.name, *(_share_text(line.get(name)) for name in columns)) for agent, line in shares.items()]
        title = f"Share of the gap from the source model to the true vehicle that is closed [%], {DOMAINS[domain]}"
        title += " (95 % interval, paired over the seeds that did not crash)"
        made += [Table(title, ("model", *(REFERENCES[name] for name in columns)), lines)] if lines else []
    return made


def gaps(rows: Results, domain: str) -> dict[Agent, dict[str, Estimate]]:
    """Return the share of the gap that each adapted or observed hybrid closes at home, by reference."""
    shares: dict[Agent, dict[str, Estimate]] = {}
    for reference in REFERENCES if domain != UNCHANGED else ():
        flown = by_agent(rows.where(domain=domain, reference=reference, distance=0.0))
        for agent, group in flown.items():
            source = flown.get(Agent(SOURCES.get(agent.model, "")))
            if source and ORACLE in flown and (agent.n_train or agent.observer):
                after, before = group.paired(source, ERROR)
                best = group.paired(flown[ORACLE], ERROR)[1]
                shares.setdefault(agent, {})[reference] = share_of_gap(before, after, best)
    return shares


def speed_table(speeds: Mapping[str, Mapping[str, Any]]) -> Table:
    header = ("model", "median [ms]", "99 of 100 are below [ms]", "processor time, mean [ms]")
    keys = ("median_ms", "p99_ms", "processor_ms")
    lines = [(name, *(f"{speed[key]:.2f}" for key in keys)) for name, speed in speeds.items()]
    return Table("One call of the controller, on one core", header, lines)


def number_text(column: str, factor: float, form: str) -> Cell:
    return lambda rows: spread_text(rows.spread(uncrashed(column, factor)), form, what="crashed")


def crash_text(rows: Results) -> str:
    values = [value for value in rows["saturation"] if value is not None]
    share = f"{100 * sum(values) / len(values):.1f}" if values else EMPTY
    return f"{sum(rows['crashed'])} of {len(rows)}; {share}"


def cost_text(rows: Results) -> str:
    sound = rows.where(lambda row: None not in (row["promised"], row["excess"]), crashed=False)
    if not len(sound):
        return EMPTY
    error = sound.spread(lambda row: 100 * row["excess"])
    return f"{sound.spread('promised').mean:.3g}; {spread_text(error, '+.1f', '.0f')}"


def _share_text(share: Estimate | None) -> str:
    if share is None:
        return EMPTY
    value, low, high = (100 * number for number in share)
    if math.isnan(value):
        return "no gap"
    return f"{value:.0f} ({'gap not significant' if math.isnan(low) else f'{low:.0f} … {high:.0f}'})"
