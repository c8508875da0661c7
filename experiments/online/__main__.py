"""The vehicle changes in the air, and the controller's model adapts: python -m experiments.online"""

from collections.abc import Mapping
from functools import partial
from typing import Any

from rich.console import Console

from experiments.online.config import PRESETS, OnlineConfig
from experiments.online.figures import draw
from experiments.online.flights import fly_all
from experiments.online.results import GoalEvidence, claims, conclusion, results_of, tables
from experiments.online.timing import step_time
from experiments.reporting.claims import evaluate, verdict_table, with_recorded
from experiments.reporting.report import Report, rows_in
from experiments.runner import command
from experiments.runner.stages import stages_of

NAME = "online"

HEAD = """\
At 4 s the simulated quadrotor changes in the air: other moments of inertia (experiment 1), a load of 20 % of its mass
off centre, a side wind of 4 N with a sine of 1 N (experiment 2), one rotor 15 % weaker, twice the drag; or nothing. The
controller sees samples with noise; its commands arrive 10 ms later, and the rotors follow with a lag of 30 ms, both of
which it and all estimators predict. Everything but the change and the agent is the same, noise included.

- **not adapted**: the rigid body of the data sheet with its drag
- **disturbance observer**: the same, with the constant acceleration that explains the last prediction errors
- **L1 adaptive augmentation**: the same, with the thrust and torques that a predictor finds missing added to commands
- **least squares after 10 s on the ground**: all parameters and a disturbance fitted to ten seconds of random flight
  after the change, with the same noise, known from the moment of the change on
- **online adaptation**: `hj.OnlineAdaptation`, which does not know when and what: inertia (3), centre of mass (2),
  efficiency of each rotor (4), added drag (3) and a constant force and torque (6). It knows which may change together
  (`hj.Hypothesis`): inertia; a load (mass, inertia and centre of mass); each rotor; drag; a force that may vary
- **oracle**: the true parameters from the moment of the change on, and the wind at each moment

No agent knows the ground effect, which the low pass meets. A flight crashes below the ground or 10 m off; its error
then counts as infinite. The settings of filter, observer and L1 were chosen on flights of other seeds.
"""


def experiment(config: OnlineConfig, console: Console) -> None:
    stages = stages_of(config, console)
    run = fly_all(config, stages)
    step, clock = step_time(config.hardware(), config.controller().period), (run.seconds, run.processor_seconds)
    stages.publish(NAME, config, results_of(run), report, step_ms=step, clock=clock)


def report(record: Mapping[str, Any]) -> Report:
    rows, step = rows_in(record), record["step_ms"]
    evidence = GoalEvidence(rows, step, *record.get("clock", (None, None)))
    verdicts = with_recorded(evaluate(claims(record["config"]["changes"]), evidence), record)
    notes = [f"One step of the filter: {step:.3f} ms of processor time on one core, in a compiled loop."]
    made = [verdict_table(verdicts, "Goals"), *tables(rows)]
    return Report(record, draw(rows), made, conclusion(rows), verdicts, HEAD, notes)


ABOUT = "The vehicle changes in the air. How soon does the controller fly as well as one that knows the change?"
main = partial(command.run, NAME, ABOUT, experiment, presets=PRESETS)

if __name__ == "__main__":
    main()
