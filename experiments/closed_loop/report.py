"""What the closed-loop experiment leaves in its folder: report.json, rows.csv, report.md and the figures."""

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, field
from functools import partial
from typing import Any

import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure
from rich.console import Console

from experiments.closed_loop import figures as figures
from experiments.closed_loop.claims import Speed, claims
from experiments.closed_loop.lanes import DRAW_EVERY, PATHS, Flights
from experiments.closed_loop.path_figures import paths, strip
from experiments.closed_loop.rows import FlightRow, Flyer, to_csv
from experiments.closed_loop.tables import ablation_tables, gap_tables, speed_table, tables
from experiments.paper.figures import save_figure
from experiments.paper.rows import NAMES
from experiments.reporting.environment import environment
from experiments.reporting.report import print_tables
from experiments.reporting.report_page import sections
from experiments.reporting.report_tables import Table, verdicts
from hybrid_jax.control import Controller, sample
from hybrid_jax.io.files import json_text, json_value, write_atomic
from hybrid_jax.sim.domain import EXTERNAL_FORCE, PARAMETER_SHIFT
from hybrid_jax.sim.render import FRAME_HEIGHT, FRAME_WIDTH, frames
from hybrid_jax.state import POSITION
from hybrid_jax.vehicle import IRIS

SHOWN_TIMES = (0.0, 0.5, 1.0, 2.0, 4.0, 8.0)  # s, of the strip
HEAD = """# closed_loop

A model predictive controller flies the simulated quadrotor after a change that its models have or have not adapted to:
other moments of inertia (parameter shift), or a side wind of 4 N with a sine of 1 N (external force). Every 0.01 s it
plans 1 s ahead with the model that it carries; nothing else differs between the flights of a column. The truth's state
is known to it without noise.

- **nominal physics**: the rigid body as in the data sheet, never trained
- **physics**: the same, its Ix, Iy, k fitted to N target trajectories of 0.1 s
- **hybrid**: physics plus the paper's network, trained on source flight (source), then on N target trajectories
- **no-physics**: the paper's network alone
- **safe hybrid**: a hybrid whose network sees neither p_x, p_y nor yaw, but by default how near each rotor is to the
  ground (--safe-inputs); adds a force and a torque, a linear part of them past its hidden layer (--safe-linear); a
  smaller one, which all rotors share, adds to the thrust of each (--safe-outputs); and the output bias, which is what a
  steady force is, moves at a rate of its own in adaptation (--safe-offset)
- **safe, nine numbers**: the safe hybrid of the source, its network left as it is; least squares fits Ix, Iy, k and a
  constant disturbance (three accelerations, three angular ones) to N target trajectories, without validation flights;
  by default the disturbance stays at zero where these, each left out in turn, are predicted no better with it
  (--safe-disturbance)
- **true vehicle, mean wind**: the simulator's own equations and the wind's mean; no bound, for an observer follows the
  sine as well
- **+ observer**: a disturbance observer adds the constant acceleration that explains the last prediction errors

RMSE: over the flight after its start. A flight crashed if it went below the ground or 10 m astray, and then counts as
infinitely far off. Promised: what the plan of a call costs by the model; realised: what its inputs, flown for 1 s
without another call, cost in the truth; of calls every 0.5 s. Before the change (unchanged vehicle) what was not
adapted flies as well: what promises were worth on the vehicle that the source networks learned.
"""


@dataclass
class Outcome:
    """All that the report is made of.

    Attributes:
        home, away, ablation: blocks of flights.
        speeds: by model, see `call_times.on_one_core`.
        seconds: of the stages of training.
        notes: on these.
    """

    home: list[Flights] = field(default_factory=list)
    away: list[Flights] = field(default_factory=list)
    ablation: list[Flights] = field(default_factory=list)
    speeds: dict[str, dict[str, float]] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)

    def flights(self) -> list[Flights]:
        """All blocks."""
        return [*self.home, *self.away, *self.ablation]


def write(name: str, config: Any, outcome: Outcome, console: Console) -> None:
    """Write everything, report.json last, and print the tables."""
    out, few = config.out / name, min(config.sizes)
    rows, ablated = (rows_of(blocks) for blocks in ([*outcome.home, *outcome.away], outcome.ablation))
    judged = claims(rows, few, speed_of(outcome, config.seconds, few))
    told = [
        verdicts(judged)._replace(title="What was to be reached"),
        *tables(rows),
        *gap_tables(rows),
        *ablation_tables(ablated),
        speed_table(outcome.speeds),
    ]
    drawn, missing = draw(rows, ablated, outcome, few)
    for file, (figure, _) in drawn.items():
        save_figure(figure, out / file)
    seconds = outcome.seconds | seconds_of(outcome.flights())
    record = {
        "experiment": name,
        "config": config.described(),
        "environment": environment(seconds),
        "rows": [asdict(row) for row in rows],
        "ablation": [asdict(row) for row in ablated],
        "claims": [asdict(claim) for claim in judged if claim.holds is not None],
        "not_judged": [{"id": c.id, "text": c.text, "why": c.measured} for c in judged if c.holds is None],
        "speed": outcome.speeds,
        "figures": {f"{file}.png": caption for file, (_, caption) in drawn.items()},
        "notes": [*missing, *outcome.notes],
    }
    for file, text in texts(json_value(record), told, to_csv([*rows, *ablated])).items():
        write_atomic(out / file, text)
    print_tables(console, told)


def texts(record: dict[str, Any], told: Sequence[Table], csv: str) -> dict[str, str]:
    """The text of each file; the record, as JSON values, last."""
    used = json.dumps(record["config"], indent=1, ensure_ascii=False)
    page = sections(HEAD.strip(), told, record["figures"], record["notes"], record["environment"], used)
    return {"rows.csv": csv, "report.md": page, "report.json": json_text(record)}


def rows_of(blocks: Sequence[Flights]) -> list[FlightRow]:
    """The rows of all flights."""
    return [row for block in blocks for row in block.rows()]


def seconds_of(blocks: Sequence[Flights]) -> dict[str, float]:
    """The seconds of all blocks of a name: what is flown at home is flown again in the ablation."""
    names = dict.fromkeys(f"flights {block.block.name}" for block in blocks)
    return {name: sum(each.seconds for each in blocks if f"flights {each.block.name}" == name) for name in names}


def speed_of(outcome: Outcome, seconds: float, few: int) -> Speed:
    """How fast it was."""
    call = outcome.speeds[Flyer("hybrid", few).name]
    blocks = outcome.flights()
    return Speed(
        call_ms=call["processor_ms"],
        median_ms=call["median_ms"],
        lane_seconds=seconds * sum(len(block.block.keys()) for block in blocks),
        seconds=sum(block.seconds for block in blocks),
        processor_seconds=sum(block.processor_seconds for block in blocks),
        devices=blocks[0].devices,
    )


def draw(
    rows: Sequence[FlightRow], ablated: Sequence[FlightRow], outcome: Outcome, few: int
) -> tuple[dict[str, tuple[Figure, str]], list[str]]:
    """Figures with their captions by file, and notes on what could not be drawn."""
    made, missing = {}, []
    for file, caption, drawn in _figures(rows, ablated, outcome, few):
        try:
            made[file] = drawn(), caption
        except ValueError as error:  # nothing of it was flown, or no renderer
            missing.append(f"{file}.png is missing: {error}.")
    return made, missing


def _figures(
    rows: Sequence[FlightRow], ablated: Sequence[FlightRow], outcome: Outcome, few: int
) -> Iterator[tuple[str, str, Callable[[], Figure]]]:
    """The file, the caption and the drawing of each figure."""
    adapted = (Flyer("hybrid", few), Flyer("safe", few), Flyer("nine", few))
    followed = (Flyer("nominal"), Flyer("hybrid"), *adapted, Flyer("oracle"))
    promising = (Flyer("nominal"), Flyer("hybrid"), Flyer("safe"), *adapted, Flyer("oracle"))
    for domain in (PARAMETER_SHIFT.name, EXTERNAL_FORCE.name):
        name = NAMES[domain]
        errors, gap, paths = f"errors_{domain}", f"gap_{domain}", f"paths_{domain}"
        yield errors, f"Position RMSE of all seeds of all models, {name}", partial(figures.errors, rows, domain)
        yield gap, f"How much of the gap to the truth is closed, {name}", partial(figures.shares, rows, domain)
        yield paths, f"Flights of seed 0, {name}", partial(flown_paths, outcome.home, domain, followed)
        if ablated:
            drawn = partial(figures.ablation, ablated, domain)
            yield f"ablation_{domain}", f"The safe network's options, {name}", drawn
    yield "promises", "Promised and realised cost of plans", partial(figures.promised, rows, promising)
    yield "away", "The same flights far from home", partial(figures.far_from_home, rows)
    yield "strip", "Hover in the wind, rendered; the red mark is the reference", partial(rendered, outcome.home, few)


def flown_paths(blocks: Sequence[Flights], domain: str, flyers: Sequence[Flyer]) -> Figure:
    """The flights of seed 0 of some models beside their references.

    Raises:
        ValueError: none of the references that are shown was flown.
    """
    own = {block.block.reference: block for block in blocks if block.block.domain.name == domain}
    chosen = [name for name in ("hover", "figure_eight", "low_pass") if name in own]
    flights = {name: {flyer: own[name].states(flyer) for flyer in flyers} for name in chosen}
    controller = Controller(IRIS)
    dt = DRAW_EVERY * controller.period
    wanted = {}
    for name in chosen:
        length = len(own[name].states(flyers[0]))
        states = sample(PATHS[name], controller, dt * (length - 1))
        wanted[name] = np.asarray(states[: DRAW_EVERY * length : DRAW_EVERY])
    return paths(flights, wanted, dt, f"{NAMES[domain].capitalize()}: flights of one seed")


def rendered(blocks: Sequence[Flights], few: int) -> Figure:
    """Hover in the wind, before and after adaptation, as pictures.

    Raises:
        ValueError: this machine cannot draw without a screen, or nothing hovered.
    """
    found = [b for b in blocks if (b.block.domain.name, b.block.reference) == (EXTERNAL_FORCE.name, "hover")]
    if not found:
        raise ValueError("nothing hovered in the wind")
    dt = DRAW_EVERY * Controller(IRIS).period
    place = np.asarray(PATHS["hover"](jnp.zeros(()))[0])
    flyers = (Flyer("hybrid"), Flyer("hybrid", few), Flyer("safe", few))
    states = np.stack([found[0].states(flyer) for flyer in flyers])
    times = [t for t in SHOWN_TIMES if t < dt * states.shape[1]]
    shown = states[:, [round(t / dt) for t in times]]
    if not np.isfinite(shown).all():
        raise ValueError("a flight is not finite")
    images = frames(shown[..., :7].reshape(-1, 7), place).reshape(*shown.shape[:2], FRAME_HEIGHT, FRAME_WIDTH, 3)
    pictures = {flyer.name: images[i] for i, flyer in enumerate(flyers)}
    off = np.linalg.norm(shown[..., POSITION] - place, axis=-1)
    errors = {flyer.name: off[i] for i, flyer in enumerate(flyers)}
    return strip(pictures, times, errors, "Hover in the wind: the red mark is where to stay")
