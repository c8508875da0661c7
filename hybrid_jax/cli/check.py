"""The verb `hybrid-jax check`: compare predictions with flights and baselines, and find where they are wrong."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro
from jaxtyping import Float

from hybrid_jax.cli import errors, identify, page
from hybrid_jax.cli.command import step
from hybrid_jax.cli.logs import FlightOptions, Flights, Known, flights_for, known_of, unlike
from hybrid_jax.dynamics.rigid_body import FrozenRates, Kinematics, rigid_body
from hybrid_jax.flights.windows import flight_of
from hybrid_jax.identification.learning import UNITS, errors_of, ratio, rmse, rmse_by_flight
from hybrid_jax.io.models import load

__all__ = ["Options", "run"]
LONGER = 5  # times the window that the model learned from
WORST = 5  # moments that are listed


@dataclass(frozen=True)
class Options(FlightOptions):
    """Compare the predictions of a model with held-out flights and with simple baselines."""

    model: Annotated[Path, tyro.conf.Positional]
    """Model that `hybrid-jax fit` or `adapt` wrote."""
    flights: Annotated[Path, tyro.conf.Positional]
    """Folder of logs."""
    out: Path = Path("runs/check")
    """Folder for report.html and report.json."""


def run(options: Options) -> int:
    model = load(options.model)
    if "identified" in model.about:
        return identify.check(options, model)
    known = known_of(options.model, model)
    flights = flights_for(known, options.flights, options, changed=False)
    with step("predicting") as done:
        others = {"thrust, rates frozen": FrozenRates(rigid_body(known.vehicle)), "no forces": Kinematics()}
        steps = LONGER * known.steps
        each = [errors_of(known.field, log, steps) for log in flights.logs]
        curves = {"model": np.stack([rmse(one) for one in each])}
        curves |= {name: rmse_by_flight(field, flights.logs, steps) for name, field in others.items()}
        done(f"{sum(map(len, each))} windows")
    places = {"short": known.steps - 1, "long": -1}
    ends = {name: {end: found[:, at] for end, at in places.items()} for name, found in curves.items()}
    for end in ends.values():  # over all flights
        end["mean"] = rmse(end["short"])
    shown = _page(options, known, flights, curves, each)
    page.write(options.out, "check", shown, {"flights": list(flights.contents), "units": UNITS, "rmse": ends})
    return 0


def _page(options: Options, known: Known, flights: Flights, curves: dict[str, Any], each) -> page.Page:
    at, frozen = known.steps - 1, curves["thrust, rates frozen"]
    better = ratio(frozen[:, at], curves["model"][:, at])
    rows = [(name, *errors.texts(rmse(found[:, at]))) for name, found in curves.items()]
    header = ("", *(name.replace("_", " ") for name in UNITS))
    names = [flight_of(log) for log in flights.logs]
    by_flight = [(name, *errors.texts(curves["model"][i, at])) for i, name in enumerate(names)]
    beaten = f"{better:.2g} times as accurate as" if better > 1 else "no better than"
    worse = [name for i, name in enumerate(names) if (curves["model"][i, at] > frozen[i, at]).all()]
    meaning = [f"The model is worse than frozen rates in every quantity on {', '.join(worse)}."] if worse else []
    return page.Page(
        f"How well does {options.model.name} predict {page.counted(names, 'flight')} of {options.flights}?",
        f"Its predictions of {known.steps * known.dt:g} s are {beaten} with frozen rates.",
        page.Table(f"RMSE after {known.steps * known.dt:g} s", header, rows),
        [("RMSE over the time since a prediction began, all flights", errors.figure(curves, known.dt))],
        [*meaning, errors.BASELINE, *unlike(known, flights), *flights.warnings],
        [f"If it is wrong for long: hybrid-jax adapt {options.model} {options.flights} -o adapted.npz."],
        [
            page.Table("When it is most wrong", ("flight", "at", *header[1:]), _worst(known, flights, names, each)),
            page.Table("RMSE on each flight", ("flight", *header[1:]), by_flight),
        ],
        flights.notes,
    )


def _worst(known: Known, flights: Flights, names: list[str], each: list[Float[np.ndarray, "n t 4"]]) -> list[tuple]:
    typical = np.sqrt(np.mean(np.concatenate([np.square(one[:, -1]) for one in each]), axis=0))
    ends = [
        (end, name, float(log.t[min(j * LONGER * known.steps, len(log) - 1)] - log.t[0]))
        for log, name, one in zip(flights.logs, names, each, strict=True)
        for j, end in enumerate(one[:, -1])
    ]
    ends.sort(key=lambda moment: -(moment[0] / typical).max())
    return [(name, f"{time:.1f} s", *errors.texts(end)) for end, name, time in ends[:WORST]]
