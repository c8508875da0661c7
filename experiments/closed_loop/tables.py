"""The tables of closed-loop flight: a line for each that flies, a column for each reference."""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from experiments.closed_loop.rows import (
    DOMAINS,
    NAMES,
    REFERENCES,
    SOURCES,
    UNCHANGED,
    Cells,
    FlightRow,
    Flyer,
    cells,
    paired,
)
from experiments.paper.summary import spread
from experiments.reporting.paired import Interval, share_of_gap
from experiments.reporting.report_tables import Table

ORACLE = Flyer("oracle")
Text = Callable[[Sequence[FlightRow]], str]


def tables(rows: Sequence[FlightRow]) -> list[Table]:
    """All tables of flights, at home and away from it."""
    found = cells(rows)
    seeds = len({row.seed for row in rows})
    of = f"mean ± std over {seeds} seeds" if seeds > 1 else "one seed"
    titles: list[tuple[str, Text]] = [
        (f"Position RMSE [cm] ({of}; less is better)", number_text("position_rmse", 100.0, 2)),
        (f"Largest position error [cm] ({of})", number_text("largest_error", 100.0, 1)),
        (f"Yaw RMSE [°] ({of})", number_text("yaw_rmse", 180 / math.pi, 2)),
        ("Crashes; share of rotor speeds at a limit [%]", crash_text),
        (f"Promised cost of a plan, and by how much the realised one exceeds it [%] ({of})", promise_text),
    ]
    made = []
    for domain, distance in _places(found):
        for title, text in titles if not distance else titles[:1]:
            place = NAMES[domain] + (f", {distance:g} m from home" if distance else "")
            made.append(_by_reference(f"{title}, {place}", found, domain, distance, text))
    return made


def gap_tables(rows: Sequence[FlightRow]) -> list[Table]:
    """The share of the gap between the source model and the true vehicle that each way closes, after each change."""
    found, made = cells(rows), []
    for domain in (domain for domain, distance in _places(found) if not distance and domain != UNCHANGED):
        shares = gaps(found, domain)
        columns = [reference for reference in REFERENCES if any(reference in line for line in shares.values())]
        lines = [
            (flyer.name, *(_share_text(line[reference]) if reference in line else "–" for reference in columns))
            for flyer, line in shares.items()
        ]
        title = f"Share of the gap from the source model to the true vehicle that is closed [%], {NAMES[domain]}"
        made.append(
            Table(f"{title} (95 % interval, paired over the seeds that did not crash)", _header(columns), lines)
        )
    return made


def gaps(found: Cells, domain: str) -> dict[Flyer, dict[str, Interval]]:
    """Who flies with something learned or observed → reference → the share of the gap that this closes at home."""
    shares: dict[Flyer, dict[str, Interval]] = {}
    for reference in REFERENCES:
        group = found.get((domain, reference, 0.0), {})
        for flyer, rows in group.items():
            source = Flyer(SOURCES.get(flyer.model, "hybrid"))
            adapts = flyer.model in SOURCES and (flyer.n_train or flyer.observer)
            if adapts and source in group and ORACLE in group:
                before, after, best = (paired(group[other], rows) for other in (source, flyer, ORACLE))
                shares.setdefault(flyer, {})[reference] = share_of_gap(before, after, best)
    return shares


def ablation_tables(rows: Sequence[FlightRow]) -> list[Table]:
    """Position RMSE of each variant, a column for each reference and distance, of each domain."""
    found, made = cells(rows), []
    for domain in DOMAINS:
        places = [cell for cell in found if cell[0] == domain]
        flyers = dict.fromkeys(flyer for cell in places for flyer in found[cell])
        text = number_text("position_rmse", 100.0, 2)
        lines = [
            (flyer.variant, *(text(found[cell][flyer]) if flyer in found[cell] else "–" for cell in places))
            for flyer in flyers
        ]
        header = [REFERENCES[reference] + (f", {away:g} m away" if away else "") for _, reference, away in places]
        if places:
            n = ", ".join(dict.fromkeys(f"N = {flyer.n_train}" for flyer in flyers if flyer.n_train))
            made.append(Table(f"What makes a network safe: RMSE [cm], {NAMES[domain]}, {n}", ("", *header), lines))
    return made


def speed_table(speeds: Mapping[str, Mapping[str, Any]]) -> Table:
    """Milliseconds a call of the controller, of each model that was timed."""
    header = ("model", "median [ms]", "99 of 100 are below [ms]", "processor time, mean [ms]")
    lines = [
        (name, *(f"{speed[key]:.2f}" for key in ("median_ms", "p99_ms", "processor_ms")))
        for name, speed in speeds.items()
    ]
    return Table("One call of the controller, on one core", header, lines)


def number_text(name: str, factor: float, digits: int) -> Text:
    """Mean ± std over seeds; with crashes, how many and the median of all."""

    def text(rows: Sequence[FlightRow]) -> str:
        crashed = sum(row.crashed for row in rows)
        values = spread([factor * row.number(name) for row in rows])
        if values.non_finite:
            median = "" if math.isinf(values.median) else f", median {values.median:.{digits}f}"
            return f"{crashed or values.non_finite} of {len(rows)} {'crashed' if crashed else 'not finite'}{median}"
        return f"{values.mean:.{digits}f}" + ("" if math.isnan(values.std) else f" ± {values.std:.{digits}f}")

    return text


def crash_text(rows: Sequence[FlightRow]) -> str:
    """Crashes of how many, and the mean saturation."""
    values = [row.saturation for row in rows if row.saturation is not None]
    share = f"{100 * sum(values) / len(values):.1f}" if values else "–"
    return f"{sum(row.crashed for row in rows)} of {len(rows)}; {share}"


def promise_text(rows: Sequence[FlightRow]) -> str:
    """The mean promise, and the excess of the realised cost."""
    sound = [row for row in rows if row.promised is not None and row.excess is not None and not row.crashed]
    if not sound:
        return "–"
    promised, broken = (
        spread([row.promised or 0.0 for row in sound]),
        spread([100 * (row.excess or 0.0) for row in sound]),
    )
    apart = "" if math.isnan(broken.std) else f" ± {broken.std:.0f}"
    return f"{promised.mean:.3g}; {broken.mean:+.1f}{apart}"


def _places(found: Cells) -> list[tuple[str, float]]:
    places = dict.fromkeys((domain, distance) for domain, _, distance in found)
    return sorted(places, key=lambda place: (DOMAINS.index(place[0]), place[1]))


def _by_reference(title: str, found: Cells, domain: str, distance: float, text: Text) -> Table:
    columns = [reference for reference in REFERENCES if (domain, reference, distance) in found]
    groups = [found[domain, reference, distance] for reference in columns]
    flyers = dict.fromkeys(flyer for group in groups for flyer in group)
    lines = [(flyer.name, *(text(group[flyer]) if flyer in group else "–" for group in groups)) for flyer in flyers]
    return Table(title, _header(columns), lines)


def _header(columns: Sequence[str]) -> Sequence[str]:
    return ("model", *(REFERENCES[reference] for reference in columns))


def _share_text(share: Interval) -> str:
    if math.isnan(share.value):
        return "no gap"
    ends = "no sure gap" if math.isnan(share.low) else f"{100 * share.low:.0f} … {100 * share.high:.0f}"
    return f"{100 * share.value:.0f} ({ends})"
