"""Write what the closed-loop experiment leaves in its folder: report.json, rows.csv, report.md and the figures."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure
from rich.console import Console

from experiments.closed_loop import figures
from experiments.closed_loop.claims import Evidence, Speed, claims
from experiments.closed_loop.flown import Flown, results_of
from experiments.closed_loop.path_figures import paths, strip
from experiments.closed_loop.rows import DOMAINS, ORACLE, Agent
from experiments.closed_loop.runner import DRAW_EVERY
from experiments.closed_loop.scenarios import PATHS
from experiments.closed_loop.tables import ablation_tables, gap_tables, speed_table, tables
from experiments.reporting.claims import evaluate, verdict_table
from experiments.reporting.plots import save_figures
from experiments.reporting.report import Report, write_report
from experiments.reporting.results import Results
from experiments.runner.environment import environment
from hybrid_jax.control import Controller, sample
from hybrid_jax.sim.domain import EXTERNAL_FORCE, PARAMETER_SHIFT
from hybrid_jax.sim.render import FRAME_HEIGHT, FRAME_WIDTH, frames
from hybrid_jax.state import POSITION
from hybrid_jax.vehicle import IRIS

DRAWN_TIMES = (0.0, 0.5, 1.0, 2.0, 4.0, 8.0)  # s, of the strip
HEAD = """# closed_loop

A model predictive controller flies the simulated quadrotor after a change: other moments of inertia (parameter shift),
or a side wind of 4 N with a sine of 1 N (external force). Every 0.01 s the controller plans 1 s ahead with its
prediction model; nothing else differs between the flights of a column. It knows the true state without noise.

- **nominal physics**: the rigid body of the data sheet, not trained
- **physics**: the same with Ix, Iy, k fitted to N target trajectories of 0.1 s
- **hybrid**: physics plus the paper's network, trained on source flights (source), then on N target trajectories
- **no-physics**: the paper's network alone
- **invariant hybrid**: a hybrid with a translation- and yaw-invariant residual. Its network reads neither p_x, p_y nor
  yaw, but by default the distance of each rotor from the ground (--invariant-inputs). It adds a force and a torque,
  with a linear skip connection (--invariant-linear); a smaller network, shared by all rotors, adds to the thrust of
  each (--invariant-outputs). The output bias, which represents a constant force, has its own learning rate in
  adaptation (--invariant-offset)
- **invariant, least squares**: the invariant hybrid of the source with a frozen network. Least squares fits Ix, Iy, k
  and a constant disturbance (three accelerations, three angular ones) to N target trajectories, without validation
  flights. By default the disturbance stays zero where it does not lower the leave-one-out error
  (--invariant-disturbance)
- **true vehicle, mean wind**: the simulator's own equations and the mean of the wind. It is no lower bound, because an
  observer follows the sine as well
- **+ observer**: a disturbance observer adds the constant acceleration that explains the last prediction errors

RMSE: over the flight after its initial state. A flight crashes if it goes below the ground or 10 m from the reference;
its error then counts as infinite. Predicted cost: of the plan of a call, by the prediction model (`promised` in
rows.csv). Actual cost: of the same inputs run open loop for 1 s in the true system (`realised`); the relative error is
(actual − predicted) / predicted (`excess`). Calls every 0.5 s are compared. Models that were not adapted also fly the
unchanged vehicle, on which the source networks were trained.
"""


@dataclass
class Outcome:
    """All results: flown scenarios, times of a call by model, seconds of the stages of training, and notes on these."""

    home: list[Flown] = field(default_factory=list)
    away: list[Flown] = field(default_factory=list)
    ablation: list[Flown] = field(default_factory=list)
    speeds: dict[str, dict[str, float]] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)

    def flown(self) -> list[Flown]:
        """All scenarios."""
        return [*self.home, *self.away, *self.ablation]


def write(name: str, config: Any, outcome: Outcome, console: Console) -> None:
    """Write the report and its figures, and print the tables."""
    out, few = config.out / name, min(config.sizes)
    rows, ablated = results_of([*outcome.home, *outcome.away]), results_of(outcome.ablation)
    verdicts = evaluate(claims(few), Evidence(rows, few, speed_of(outcome, config.seconds, few)))
    drawn, missing = draw(rows, ablated, outcome, few)
    report = Report(
        name,
        config.described(),
        environment(outcome.seconds | simulation_seconds(outcome.flown())),
        rows,
        verdicts,
        save_figures(out, drawn),
        [*missing, *outcome.notes],
        {"ablation": ablated.rows, "speed": outcome.speeds},
        head=HEAD.strip(),
        tables=[
            verdict_table(verdicts, "Hypotheses"),
            *tables(rows),
            *gap_tables(rows),
            *ablation_tables(ablated),
            speed_table(outcome.speeds),
        ],
        more_rows=ablated,
    )
    write_report(out, report, console)


def simulation_seconds(flown: Sequence[Flown]) -> dict[str, float]:
    """Seconds by name of the scenario; the ablation repeats some."""
    seconds: dict[str, float] = {}
    for each in flown:
        name = f"flights {each.scenario.name}"
        seconds[name] = seconds.get(name, 0.0) + each.seconds
    return seconds


def speed_of(outcome: Outcome, seconds: float, few: int) -> Speed:
    """Speed of one call, and of all flights of so many seconds."""
    call, flown = outcome.speeds[Agent("hybrid", few).name], outcome.flown()
    return Speed(
        call_ms=call["processor_ms"],
        median_ms=call["median_ms"],
        flown_seconds=seconds * sum(len(each.scenario.keys()) for each in flown),
        seconds=sum(each.seconds for each in flown),
        processor_seconds=sum(each.processor_seconds for each in flown),
        devices=flown[0].devices,
    )


def draw(
    rows: Results, ablated: Results, outcome: Outcome, few: int
) -> tuple[dict[str, tuple[Figure, str]], list[str]]:
    """Figures with their captions by file, and notes on those that could not be drawn."""
    made, missing = {}, []
    for file, caption, drawn in _figures(rows, ablated, outcome, few):
        try:
            made[file] = drawn(), caption
        except ValueError as error:  # nothing of it was flown, or there is no renderer
            missing.append(f"{file}.png is missing: {error}.")
    return made, missing


def _figures(
    rows: Results, ablated: Results, outcome: Outcome, few: int
) -> Iterator[tuple[str, str, Callable[[], Figure]]]:
    """File, caption and drawing of each figure."""
    sources, adapted = [Agent("hybrid"), Agent("invariant")], [Agent(m, few) for m in ("hybrid", "invariant")]
    adapted.append(Agent("least_squares", few))
    followed = (Agent("nominal"), sources[0], *adapted, ORACLE)
    for domain in (PARAMETER_SHIFT.name, EXTERNAL_FORCE.name):
        name = DOMAINS[domain]
        yield f"errors_{domain}", f"Position RMSE of all seeds, {name}", partial(figures.errors, rows, domain)
        yield f"gap_{domain}", f"Share of the gap to the true vehicle, {name}", partial(figures.shares, rows, domain)
        flights = partial(flown_paths, outcome.home, domain, followed)
        yield f"paths_{domain}", f"Flights of seed 0, {name}", flights
        if len(ablated):
            drawn = partial(figures.ablation, ablated, domain)
            yield f"ablation_{domain}", f"Ablation of the invariant residual, {name}", drawn
    costs = partial(figures.open_loop_costs, rows, (Agent("nominal"), *sources, *adapted, ORACLE))
    yield "open_loop_costs", "Predicted and actual open-loop cost of plans", costs
    yield "away", "The same flights away from home", partial(figures.away_from_home, rows)
    yield "strip", "Hover in the wind; the red mark is the reference", partial(rendered, outcome.home, few)


def flown_paths(flown: Sequence[Flown], domain: str, agents: Sequence[Agent]) -> Figure:
    """Flights of seed 0 and their references.

    Raises:
        ValueError: none of the references of this figure was flown.
    """
    own = {each.scenario.reference: each for each in flown if each.scenario.domain.name == domain}
    chosen = [name for name in ("hover", "figure_eight", "low_pass") if name in own]
    flights = {name: {agent: own[name].states(agent) for agent in agents} for name in chosen}
    controller = Controller(IRIS)
    dt = DRAW_EVERY * controller.period
    wanted = {}
    for name in chosen:
        length = len(own[name].states(agents[0]))
        states = sample(PATHS[name], controller, dt * (length - 1))
        wanted[name] = np.asarray(states[: DRAW_EVERY * length : DRAW_EVERY])
    return paths(flights, wanted, dt, f"{DOMAINS[domain].capitalize()}: flights of one seed")


def rendered(flown: Sequence[Flown], few: int) -> Figure:
    """Rendered images of hover in the wind, before and after adaptation.

    Raises:
        ValueError: this machine cannot render, or nothing hovered.
    """
    place = (EXTERNAL_FORCE.name, "hover")
    found = [each for each in flown if (each.scenario.domain.name, each.scenario.reference) == place]
    if not found:
        raise ValueError("nothing hovered in the wind")
    dt = DRAW_EVERY * Controller(IRIS).period
    mark = np.asarray(PATHS["hover"](jnp.zeros(()))[0])
    agents = (Agent("hybrid"), Agent("hybrid", few), Agent("invariant", few))
    states = np.stack([found[0].states(agent) for agent in agents])
    times = [t for t in DRAWN_TIMES if t < dt * states.shape[1]]
    shown = states[:, [round(t / dt) for t in times]]
    if not np.isfinite(shown).all():
        raise ValueError("a flight is not finite")
    images = frames(shown[..., :7].reshape(-1, 7), mark).reshape(*shown.shape[:2], FRAME_HEIGHT, FRAME_WIDTH, 3)
    errors = np.linalg.norm(shown[..., POSITION] - mark, axis=-1)
    pictures = {agent.name: (images[i], errors[i]) for i, agent in enumerate(agents)}
    return strip(pictures, times, "Hover in the wind: the red mark is the reference")
