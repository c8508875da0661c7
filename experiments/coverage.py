"""How often intervals of θ_p contain the truth: python -m experiments.coverage --help"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from typing import Any, Literal

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import hybrid_jax as hj
from experiments.paper.config import CHANGED, ONE_FLIGHT, QUICK, SMOKE, Change, OneFlight, preset_like
from experiments.paper.study import target_splits, windows_of
from experiments.reporting import names
from experiments.reporting.claims import Claim, Part, Undecided, all_of, evaluate, verdict_table
from experiments.reporting.plots import METHODS as COLOURS
from experiments.reporting.plots import STYLE, legend_below, name_lines, note, subplots
from experiments.reporting.report import Report, rows_in
from experiments.reporting.results import Results, Row
from experiments.reporting.tables import EMPTY, Table, tabulate
from experiments.runner import command
from experiments.runner.cache import identity_of
from experiments.runner.options import Count, Several
from experiments.runner.stages import Found, Stages, rows_of
from experiments.worlds.flights import Sources, dataset, in_each_world, sources
from experiments.worlds.world import World
from hybrid_jax.adaptation.adapting import METHODS
from hybrid_jax.adaptation.pooling import SOURCES
from hybrid_jax.adaptation.results import Parameter
from hybrid_jax.dynamics.rigid_body import LEARNED, nominal
from hybrid_jax.sweep.lanes import lane

NAME = "coverage"
TAGS = "world", "domain", "noise", "draw", "parameter"
LEVEL, ASKED, MOST = 0.95, 0.9, 0.99  # of the intervals, and the least and largest share that may hold the truth
WIDEST, FEW = 2.0, 20  # times what 95 % of the errors need, of which fewer flights say nothing
RIGHT: tuple[Change, ...] = ("parameter_shift", "external_force", "doubled_drag", "weak_rotor", "gusty_wind")


@dataclass(frozen=True)
class CoverageConfig(OneFlight):
    """Adapt to many flights after each change of the vehicle, and count how often intervals contain the true value."""

    seeds: Count = SOURCES
    """Number of sources to pool."""
    draws: Count = 100
    """Number of flights; each source adapts to one at a time."""
    noise_on: Literal["all", "target"] = "target"
    clean: bool = True
    """Also adapt to the same flights without noise."""
    changes: Several[Change] = RIGHT
    """Changes of the vehicle; by default all that keep its mass."""

    def __post_init__(self):
        OneFlight.__post_init__(self)
        if self.seeds < SOURCES:
            raise ValueError(f"--seeds must be at least {SOURCES}, got {self.seeds}")


SHORT: dict[str, Any] = ONE_FLIGHT | {"seeds": SOURCES, "noise_on": "target"}
PRESETS = {
    "paper": CoverageConfig(),
    "quick": preset_like(CoverageConfig, replace(QUICK, **SHORT, draws=20)),
    "smoke": preset_like(
        CoverageConfig, replace(SMOKE, **SHORT), sizes=(20,), worlds=("hummingbird",), changes=("parameter_shift",),
        clean=False,
    ),
}  # fmt: skip


def of_world(world: World, config: CoverageConfig, stages: Stages) -> list[Row]:
    known = sources(world, config, stages)
    levels = {0.0: "none"} if config.clean and config.noise else {}
    levels |= {config.noise: f"{config.noise:g}" if config.noise else "none"}
    return [
        {"world": world.name, **row, "noise": label}
        for change in CHANGED
        if change in config.changes
        for noise, label in levels.items()
        for row in adapted(world, change, known, replace(config, noise=noise), stages)
    ]


def report(record: Mapping[str, Any]) -> Report:
    rows = rows_in(record)
    verdicts = evaluate(CLAIMS, rows)
    tables = [verdict_table(verdicts, "Hypotheses"), worst_table(rows), pooled_table(rows)]
    return Report(record, draw(rows), tables, conclusion(rows), verdicts)


def adapted(world: World, change: str, known: Sources, config: CoverageConfig, stages: Stages) -> list[Row]:
    """Return a row for each flight and parameter: whether pooled and single intervals contain the true value."""
    splits = {"train": target_splits(config)["train"]}
    flights = dataset(world, change, splits, config, stages)
    pool = flights.splits["train"]
    drawn, truth = windows_of(METHODS["auto"], config.sizes[0], config)[0], nominal(world.changed(change))

    def of_draw(draw: int) -> Found:
        windows = pool[drawn[draw * config.seeds]]  # the same for all sources
        fields = [lane(known.fields, seed) for seed in range(config.seeds)]
        results = [hj.adapt(field, windows, learned_from=known.windows) for field in fields]
        pooled = hj.pool(results) if all(each.covariance is not None for each in results) else {}
        tags: dict[str, Any] = {"domain": change, "draw": draw}
        own = {name: [each.parameters[name] for each in results] for name in LEARNED}
        rows = [tags | {"parameter": name} | _compared(pooled.get(name), own[name], truth[name]) for name in LEARNED]
        return rows, {}

    name = f"intervals {flights.config['domain']}, noise {config.noise:g}"
    jobs = {f"flight {draw}": partial(of_draw, draw) for draw in range(config.draws)}
    return rows_of(stages.kept(name, jobs, identity_of(config.described(), known.fields, flights)))


def _compared(pooled: Parameter | None, own: Sequence[Parameter], true: float) -> dict[str, Any]:
    """Whether pooled and single intervals contain the truth; error and half-width in %; None without finite ones."""
    columns = ("inside", "error", "half_width", "alone", "effective")
    if pooled is None:
        return dict.fromkeys(columns)
    alone = [one.low <= true <= one.high for one in own if np.isfinite(one.high)]
    inside, half = bool(pooled.low <= true <= pooled.high), 100 * (pooled.high - pooled.low) / (2 * true)
    inside, half = (inside, half) if np.isfinite(pooled.high) else (None, None)
    numbers = inside, 100 * (pooled.value / true - 1), half
    effective = sum(one.effective is not None for one in own)
    return dict(zip(columns, (*numbers, float(np.mean(alone)) if alone else None, effective), strict=True))


def worst_table(rows: Results) -> Table:
    """Return a line for each change: of its parameters and noises, the one whose intervals are right least often."""
    lines = []
    for (world, change), group in rows.where(lambda row: row["inside"] is not None).group("world", "domain").items():
        case, own = min(_cases(group).items(), key=lambda case: np.mean(case[1]["inside"]))
        *_, name, noise = case.split(", ")
        shares = (percentage(own, column) for column in ("inside", "alone"))
        wide = f"{np.median(own.numbers('half_width')):.2f}"
        lines.append((names.label(world), names.label(change), f"{name}, {noise}", str(len(own)), *shares, wide))
    header = ("world", "change", "lowest for", "flights", "coverage [%]", "one source [%]", "half-width [%], median")
    return Table(f"Lowest coverage of pooled 95 % intervals of {SOURCES} sources or more", header, lines)


def percentage(rows: Results, column: str) -> str:
    known = [row[column] for row in rows if row[column] is not None]
    return f"{100 * np.mean(known):.0f}" if known else EMPTY


def pooled_table(rows: Results) -> Table:
    def text(column: str, form: str, statistic):
        def of(own: Results) -> str:
            known = [row[column] for row in own if row["inside"] is not None]
            return f"{statistic(known):{form}}" if known else EMPTY

        return of

    columns = {
        "flights": lambda own: str(sum(row["inside"] is not None for row in own)),
        "coverage [%]": partial(percentage, column="inside"),
        "one source [%]": partial(percentage, column="alone"),
        "effective": lambda own: str(sum(row["effective"] or 0 for row in own)),
        "bias [%]": text("error", "+.2f", np.mean),
        "half-width [%], median": text("half_width", ".2f", np.median),
    }
    title = f"Do pooled 95 % intervals of {SOURCES} sources or more contain the truth?"
    return tabulate(
        title, rows.group("world", "domain", "noise", "parameter"), columns, ("world", "change", "noise", "θ_p")
    )


def draw(rows: Results) -> dict[str, tuple[Figure, str]]:
    if not any(row["inside"] is not None for row in rows):
        return {}
    return {"coverage": (coverage_figure(rows), "Share of flights whose 95 % interval contains the true value")}


@mpl.rc_context(STYLE)
def coverage_figure(rows: Results) -> Figure:
    """Draw the share of intervals that contain the truth, a panel for each world and noise."""
    fitted = rows.where(lambda row: row["inside"] is not None)
    worlds, noises, changes = (fitted.unique(column) for column in ("world", "noise", "domain"))
    figure, panels = subplots(
        1.5 + 0.52 * len(worlds) * len(changes), len(worlds), len(noises), sharex=True, sharey=True
    )
    for (world, noise), axes in zip(product(worlds, noises), panels.flat, strict=True):
        _draw_shares(axes, fitted.where(world=world, noise=noise), changes)
        name_lines(axes, [*map(names.label, changes)])
        axes.set_title(f"{names.label(str(world))},\n{'without noise' if noise == 'none' else 'with sensor noise'}")
    least = panels[0, 0].get_xlim()[0]  # of all panels
    panels[0, 0].set_xlim(min(80.0, 1.1 * least - 10.0), 100.5)  # with room for names
    for axes in panels[-1]:
        axes.set_xlabel("intervals that contain\nthe true value [%]")
    meaning = "Ix, Iy: moments of inertia; k: thrust coefficient"
    return legend_below(figure, "Do 95 % intervals contain the true value?", meaning)


def _draw_shares(axes: Axes, rows: Results, changes: list) -> None:
    kinds = {
        "alone": ("one source", COLOURS["fine-tuned"], "s"),
        "inside": ("three sources, pooled", COLOURS["adapted"], "o"),
    }
    axes.axvline(100 * LEVEL, color="0.4", linestyle=":", label="nominal 95 %")
    for (domain, parameter), own in rows.group("domain", "parameter").items():
        y = changes.index(domain) + 0.22 * (LEARNED.index(parameter) - 1)
        shares = {column: float(share) for column in kinds if (share := percentage(own, column)) != EMPTY}
        axes.plot([*shares.values()], [y] * len(shares), color="0.8", zorder=1)
        for column, share in shares.items():
            label, colour, marker = kinds[column]
            axes.plot(share, y, marker, ms=4, color=colour, label=label, clip_on=False)
        edge = {"xycoords": axes.get_yaxis_transform()}
        note(axes, parameter, (0.0, y), (3, 0), va="center", color="0.4", **edge)


def conclusion(rows: Results) -> list[str]:
    fitted = rows.where(lambda row: row["inside"] is not None)
    if not len(fitted):
        return ["No parameter was fitted, so there are no intervals."]
    cases = {case: np.mean(own["inside"]) for case, own in _cases(fitted).items()}
    worst = min(cases, key=cases.__getitem__)
    trust = (
        "So they are not too narrow, after changes of these kinds."
        if cases[worst] >= ASKED
        else "Where it is below that, something acts that no parameter stands for, and the interval does not show it."
    )
    worlds = fitted.group("world").items()
    pooled, alone = (
        " and ".join(f"{percentage(own, column)}%{count.format(len(own), names.label(world))}" for world, own in worlds)
        for column, count in (("inside", " of {} in the {}"), ("alone", ""))
    )
    return [
        f"Of the pooled 95 % intervals {pooled} contain the true value, of single sources' {alone}.",
        f"The fewest do for {worst}: {cases[worst]:.0%} (required: {ASKED:.0%}). {trust}",
    ]


def _covers(rows: Results) -> Part:
    def of(name: str, own: Results) -> Part:
        inside, n = own.numbers("inside").astype(bool), len(own)
        share, margin = inside.mean(), 1.96 * np.sqrt(ASKED * (1 - ASKED) / n)
        holds = True if share >= ASKED else False if share < ASKED - margin else None
        needed = np.quantile(np.abs(own.numbers("error")), LEVEL)
        wide = np.median(own.numbers("half_width")) / needed
        too_often = share > MOST and LEVEL**n < 1 - LEVEL  # so many would seldom all hold
        measured = f"{name} {share:.2f} of {n}, {wide:.2g} times as wide as needed"
        return (False if too_often or (wide > WIDEST and n >= FEW) else holds), measured

    fitted = rows.where(lambda row: row["inside"] is not None)
    if not len(fitted):
        raise Undecided("needs a fitted parameter")
    return all_of(of(*case) for case in _cases(fitted).items())


def _cases(rows: Results) -> dict[str, Results]:
    """Return the rows of each parameter and noise, after each change in each world, by their names."""
    groups = rows.group("world", "domain", "parameter", "noise").items()
    return {f"{names.label(*of)}, {'no noise' if noise == 'none' else 'noise'}": own for (*of, noise), own in groups}


CLAIMS = (
    Claim("K1", f"At least {ASKED:.0%} and at most {MOST:.0%} of the pooled 95 % intervals contain the truth, for each "
          f"change, noise and parameter, and they are at most {WIDEST:g} times as wide as 95 % of the errors need "
          "(fails: significantly fewer or more, or wider).", _covers),
)  # fmt: skip

ABOUT = "Intervals of the physical parameters after adaptation to one flight of ten seconds: do they contain the truth?"
main = partial(command.run, NAME, ABOUT, partial(in_each_world, NAME, TAGS, of_world, report), presets=PRESETS)

if __name__ == "__main__":
    main()
