"""Write what the closed-loop experiment leaves in its folder: report.json, rows.csv, report.md and the figures."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

from matplotlib.figure import Figure
from rich.console import Console

from experiments.closed_loop import figures
from experiments.closed_loop.claims import Evidence, Speed, claims
from experiments.closed_loop.flights import Flown, results_of
from experiments.closed_loop.path_figures import flown_paths, rendered
from experiments.closed_loop.results import (
    DOMAINS,
    ORACLE,
    SOURCES,
    Agent,
    ablation_tables,
    gap_tables,
    speed_table,
    tables,
)
from experiments.reporting.claims import evaluate, verdict_table
from experiments.reporting.plots import save_figures
from experiments.reporting.report import Report, write_report
from experiments.reporting.results import Results
from experiments.runner.environment import environment
from experiments.runner.stages import Stages

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
    out, few, flown = config.out / name, min(config.sizes), [*outcome.flown, *outcome.ablation]
    rows, ablated = results_of(outcome.flown), results_of(outcome.ablation)
    speed = speed_of(outcome.speeds[Agent("hybrid", few).name], flown, config.seconds)
    verdicts = evaluate(claims(few), Evidence(rows, speed))
    drawn, missing = draw(rows, ablated, outcome.flown, few)
    seconds = dict(outcome.seconds)
    for each in flown:  # the ablation repeats some
        stage = f"flights {each.scenario.name}"
        seconds[stage] = seconds.get(stage, 0.0) + each.seconds
    titled = [verdict_table(verdicts, "Hypotheses"), *tables(rows), *gap_tables(rows), *ablation_tables(ablated)]
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
        tables=[*titled, speed_table(outcome.speeds)],
        more_rows=ablated,
    )
    write_report(out, report, console)


def speed_of(call: Mapping[str, float], flown: Sequence[Flown], seconds: float) -> Speed:
    """Speed of one call, and of all flights of so many seconds."""
    flights = sum(len(each.scenario.keys()) for each in flown)
    spent, worked = sum(each.seconds for each in flown), sum(each.processor_seconds for each in flown)
    return Speed(call["processor_ms"], call["median_ms"], seconds * flights, spent, worked, flown[0].devices)


def draw(
    rows: Results, ablated: Results, flown: Sequence[Flown], few: int
) -> tuple[dict[str, tuple[Figure, str]], list[str]]:
    """Figures with their captions by file, and notes on those that could not be drawn."""
    nominal, sources = Agent("nominal"), [Agent("hybrid"), Agent("invariant")]
    adapted = [Agent(model, few) for model in SOURCES]
    followed = (nominal, sources[0], *adapted, ORACLE)
    wanted: dict[str, tuple[str, Callable[[], Figure]]] = {}
    for domain, label in list(DOMAINS.items())[1:]:  # after the change
        for file, caption, drawing in (
            ("errors", "Position RMSE of all seeds", partial(figures.errors, rows, domain)),
            ("gap", "Share of the gap to the true vehicle", partial(figures.shares, rows, domain)),
            ("paths", "Flights of seed 0", partial(flown_paths, flown, domain, followed)),
            ("ablation", "Ablation of the invariant residual", partial(figures.errors, ablated, domain, True)),
        ):
            if file != "ablation" or len(ablated):
                wanted[f"{file}_{domain}"] = f"{caption}, {label}", drawing
    costs = partial(figures.open_loop_costs, rows, (nominal, *sources, *adapted, ORACLE))
    wanted["open_loop_costs"] = "Predicted and actual open-loop cost of plans", costs
    wanted["away"] = "The same flights away from home", partial(figures.away_from_home, rows)
    wanted["strip"] = "Hover in the wind; the red mark is the reference", partial(rendered, flown, few)
    made, missing = {}, []
    for file, (caption, drawing) in wanted.items():
        try:
            made[file] = drawing(), caption
        except ValueError as error:  # nothing of it was flown, or there is no renderer
            missing.append(f"{file}.png is missing: {error}.")
    return made, missing
