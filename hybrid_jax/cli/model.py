"""Read models written by `hybrid-jax fit` and `adapt` for the other verbs."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from hybrid_jax.cli.learning import lagged
from hybrid_jax.cli.logs import FlightOptions, Flights, read_flights, require_unseen
from hybrid_jax.dynamics.base import AbstractVectorField
from hybrid_jax.dynamics.rigid_body import RIGID_BODY_SPACE
from hybrid_jax.export.program import vehicle_in
from hybrid_jax.extrapolation import WARN, shares_outside
from hybrid_jax.io.models import Model
from hybrid_jax.trajectories import Trajectories
from hybrid_jax.vehicle import Vehicle


class Known(NamedTuple):
    """A model of a vehicle, with its constants and the metadata written by `fit`."""

    field: AbstractVectorField
    vehicle: Vehicle
    about: Mapping[str, Any]

    @property
    def dt(self) -> float:
        return self.about["dt"]

    @property
    def steps(self) -> int:
        return self.about["steps"]

    @property
    def windows(self) -> Trajectories:
        """Some of the windows that the model was learned from."""
        x0, u, x = (np.asarray(self.about["windows"][part], "f4") for part in ("x0", "u", "x"))
        return Trajectories(x0, u, x, self.dt)


def known_of(path: Path, model: Model) -> Known:
    """Convert a model from a file; raise ValueError if `fit` or `adapt` did not write it."""
    vehicle = vehicle_in(model.field)
    if "identified" in model.about:
        raise ValueError(f"{path}: was identified without states, which replay draws; hybrid-jax check predicts logs")
    if vehicle is None or not {"dt", "steps", "learned_from", "motion", "windows"} <= model.about.keys():
        raise ValueError(f"{path}: is not a model written by hybrid-jax fit or adapt")
    return Known(model.field, vehicle, model.about)


def reading_of(known: Known, options: FlightOptions) -> Any:
    """Complete the options with the model's conversion from commands to speeds."""
    if options.polynomial or not known.about.get("polynomial"):
        return options
    return replace(options, polynomial=tuple(known.about["polynomial"]))


def flights_for(known: Known, folder: Path, options: FlightOptions, changed: bool) -> Flights:
    """Read the flights of a folder; none of them may be one of the model's training flights."""
    lag = known.about.get("lag", 0.0)
    found = read_flights(folder, known.vehicle, known.dt, reading_of(known, options), changed, lag > 0)
    require_unseen(known.about["learned_from"], found.contents)
    return found._replace(logs=lagged(found.logs, lag))


def unlike(known: Known, flights: Flights) -> list[str]:
    """Warn about quantities that are often outside the training range."""
    learned = {name: np.asarray(values) for name, values in known.about["motion"].items()}
    x, u = (np.concatenate([getattr(log, part) for log in flights.logs]) for part in ("x", "u"))
    asked = RIGID_BODY_SPACE.features(x, u)
    shares = shares_outside(learned, asked)
    told = ", ".join(f"{name.partition(' [')[0]} {share:.0%}" for name, share in shares.items() if share > WARN)
    more = "of the time; errors there may be larger than expected."
    return [f"These flights have motion that the training flights did not have: {told} {more}"] if told else []
