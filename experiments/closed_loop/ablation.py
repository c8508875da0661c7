"""What makes a network safe for control, one option at a time: what it reads and writes, and how it is flown."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Literal

from rich.console import Console

from experiments.closed_loop.common_field import CommonField
from experiments.closed_loop.models import Trained, in_common, train, with_statistics_of
from experiments.closed_loop.rows import Flyer
from experiments.paper.config import Config, ResidualInputs, ResidualOutputs
from hybrid_jax.sim.domain import Domain
from hybrid_jax.vehicle import Vehicle

Option = Literal["networks", "offset", "statistics", "quaternion"]
PAPER, SAFE = "paper: all of x → all 13", "safe: no p_x, p_y, yaw → v̇, ω̇"
NETWORKS: dict[str, tuple[ResidualInputs, ResidualOutputs]] = {
    PAPER: ("all", "all"),
    "no p_x, p_y → all 13": ("no_xy", "all"),
    "all of x → v̇, ω̇": ("all", "accelerations"),
    "no p_x, p_y → v̇, ω̇": ("no_xy", "accelerations"),
    SAFE: ("no_xy_yaw", "accelerations"),
}
COMPARED = (PAPER, SAFE)  # of what more is undone than what they read and write
SLOW = "safe, its output bias as slow as the rest"


def networks(
    options: Sequence[Option], vehicle: Vehicle, config: Config, console: Console, domains: Sequence[Domain]
) -> tuple[dict[str, Trained], dict[str, float], list[str]]:
    """The trained networks by name, the seconds of their stages, and notes on these."""
    asked = {name: NETWORKS[name] for name in NETWORKS if "networks" in options or name in COMPARED}
    if "offset" in options:
        asked[SLOW] = NETWORKS[SAFE]
    trained, seconds, notes = {}, {}, []
    for name, (inputs, outputs) in asked.items():
        # What writes all derivatives is adapted as the paper does it.
        fast = outputs == "accelerations" and name != SLOW
        rates = replace(config.rates, offset=config.rates.offset if fast else None)
        other = replace(config, residual_inputs=inputs, residual_outputs=outputs, rates=rates)
        trained[name], stages = train(f"ablation, {name}", "hybrid", vehicle, other, console, domains)
        seconds |= {f"ablation, {name}, {stage}": spent for stage, spent in stages.seconds.items()}
        notes += [f"{name}: {note}" for note in stages.notes()]
    return trained, seconds, notes


def variants(
    options: Sequence[Option], domain: Domain, vehicle: Vehicle, trained: dict[str, Trained], config: Config
) -> dict[Flyer, CommonField]:
    """What flies with the usual controller: each network, with the statistics of the source, and not adapted at all,
    but with an observer.
    """
    (few,) = config.sizes
    fields: dict[Flyer, Any] = {flyer(name, few): found.adapted[domain.name, few] for name, found in trained.items()}
    if "statistics" in options and config.norm == "batch":
        for name in COMPARED:
            field = trained[name].adapted[domain.name, few]
            wrong = with_statistics_of(trained[name].source, field)
            fields[flyer(with_change(name, "batch statistics of the source"), few)] = wrong
    for name in COMPARED:
        unadapted = flyer(with_change(name, "not adapted, + observer"), 0)
        fields[replace(unadapted, observer=True)] = trained[name].source
    return {who: in_common(field, vehicle, config) for who, field in fields.items()}


def unnormalised(
    domain: Domain, vehicle: Vehicle, trained: dict[str, Trained], config: Config
) -> dict[Flyer, CommonField]:
    """What flies with a controller whose predictions let the quaternion's length drift."""
    (few,) = config.sizes
    fields = {name: trained[name].adapted[domain.name, few] for name in COMPARED}
    return {
        flyer(with_change(name, "|q| not renormalised"), few): in_common(field, vehicle, config)
        for name, field in fields.items()
    }


def with_change(name: str, change: str) -> str:
    """The name of a network of which something else was changed."""
    return f"{name.partition(':')[0]}, {change}"


def flyer(name: str, few: int) -> Flyer:
    """A network under its name."""
    return Flyer("safe" if name.startswith("safe") else "hybrid", few, variant=name)
