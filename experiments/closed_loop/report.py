"""Write what the closed-loop experiment leaves in its folder: report.json, rows.csv, report.md and the figures."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure
from rich.console import Console

from experiments.closed_loop import figures
from experiments.closed_loop.claims import THREE, Evidence, Speed, claims
from experiments.closed_loop.flown import Flown, results_of
from experiments.closed_loop.path_figures import paths, strip
from experiments.closed_loop.rows import DOMAINS, ORACLE, SOURCES, Agent
from experiments.closed_loop.runner import DRAW_EVERY
from experiments.closed_loop.scenarios import PATHS
from experiments.closed_loop.tables import ablation_tables, gap_tables, speed_table, tables
from experiments.render import FRAME_HEIGHT, FRAME_WIDTH, frames
from experiments.reporting.claims import evaluate, verdict_table
from experiments.reporting.plots import save_figures
from experiments.reporting.report import Report, write_report
from experiments.reporting.results import Results
from experiments.runner.environment import environment
from experiments.runner.stages import Stages
from hybrid_jax.control import Controller, sample
from hybrid_jax.sim.domain import EXTERNAL_FORCE, PARAMETER_SHIFT
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

    flown: list[Flown] = field(default_factory=list)
    ablation: list[Flown] = field(default_factory=list)
    speeds: dict[str, dict[str, float]] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)

    def record(self, name: str, stages: Stages) -> None:
        """Keep the seconds of the stages of a model, and the notes on them."""
        self.seconds |= {f"{name}, {stage}": seconds for stage, seconds in stages.seconds.items()}
        self.notes += [f"{name}: {note}" for note in stages.notes()]


def write(name: str, config: Any, outcome: Outcome, console: Console) -> None:
    """Write the report and its figures, and print the tables."""
    out, few = config.out / name, min(config.sizes)
    rows, ablated = results_of(outcome.flown), results_of(outcome.ablation)
    verdicts = evaluate(claims(few), Evidence(rows, few, speed_of(outcome, config.seconds, few)))
    drawn, missing = draw(rows, ablated, outcome, few)
    seconds = dict(outcome.seconds)
    for each in [*outcome.flown, *outcome.ablation]:  # the ablation repeats some
        stage = f"flights {each.scenario.name}"
        seconds[stage] = seconds.get(stage, 0.0) + each.seconds
    report = Report(
        experiment=name,
        config=config.described(),
        environment=environment(seconds),
        rows=rows,
        claims=verdicts,
        figures=save_figures(out, drawn),
        notes=[*missing, *outcome.notes],
        extra={"ablation": ablated.rows, "speed": outcome.speeds},
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


def speed_of(outcome: Outcome, seconds: float, few: int) -> Speed:
    """Speed of one call, and of all flights of so many seconds."""
    call, flown = outcome.speeds[Agent("hybrid", few).name], [*outcome.flown, *outcome.ablation]
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
    sources, adapted = [Agent("hybrid"), Agent("invariant")], [Agent(model, few) for model in SOURCES]
    followed = (Agent("nominal"), sources[0], *adapted, ORACLE)
    wanted: dict[str, tuple[str, Callable[[], Figure]]] = {}
    for domain in (PARAMETER_SHIFT.name, EXTERNAL_FORCE.name):
        for file, caption, drawing in (
            ("errors", "Position RMSE of all seeds", partial(figures.errors, rows, domain)),
            ("gap", "Share of the gap to the true vehicle", partial(figures.shares, rows, domain)),
            ("paths", "Flights of seed 0", partial(flown_paths, outcome.flown, domain, followed)),
            ("ablation", "Ablation of the invariant residual", partial(figures.ablation, ablated, domain)),
        ):
            if file != "ablation" or len(ablated):
                wanted[f"{file}_{domain}"] = f"{caption}, {DOMAINS[domain]}", drawing
    costs = partial(figures.open_loop_costs, rows, (Agent("nominal"), *sources, *adapted, ORACLE))
    wanted["open_loop_costs"] = "Predicted and actual open-loop cost of plans", costs
    wanted["away"] = "The same flights away from home", partial(figures.away_from_home, rows)
    hover = partial(rendered, outcome.flown, few)
    wanted["strip"] = "Hover in the wind; the red mark is the reference", hover
    made, missing = {}, []
    for file, (caption, drawing) in wanted.items():
        try:
            made[file] = drawing(), caption
        except ValueError as error:  # nothing of it was flown, or there is no renderer
            missing.append(f"{file}.png is missing: {error}.")
    return made, missing


def flown_paths(flown: Sequence[Flown], domain: str, agents: Sequence[Agent]) -> Figure:
    """Flights of seed 0 and their references."""
    own = {each.scenario.name: each for each in flown}
    at_home = {name: own[f"{domain} {name}"] for name in THREE if f"{domain} {name}" in own}
    flights = {name: {agent: each.states(agent) for agent in agents} for name, each in at_home.items()}
    controller = Controller(IRIS)
    dt = DRAW_EVERY * controller.period
    wanted = {}
    for name, states in flights.items():
        length = len(states[agents[0]])
        reference = sample(PATHS[name], controller, dt * (length - 1))
        wanted[name] = np.asarray(reference[: DRAW_EVERY * length : DRAW_EVERY])
    return paths(flights, wanted, dt, f"{DOMAINS[domain].capitalize()}: flights of one seed")


def rendered(flown: Sequence[Flown], few: int) -> Figure:
    """Rendered images of hover in the wind, before and after adaptation."""
    found = [each for each in flown if each.scenario.name == f"{EXTERNAL_FORCE.name} hover"]
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
