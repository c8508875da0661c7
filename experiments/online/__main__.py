"""The vehicle changes in the air, and the controller's model adapts: python -m experiments.online"""

from collections.abc import Mapping
from functools import partial
from typing import Any

import numpy as np
from rich.console import Console

from experiments.online.config import PRESETS, OnlineConfig
from experiments.online.figures import draw
from experiments.online.flights import fly_all
from experiments.online.results import TAGS, GoalEvidence, claims, conclusion, results_of, tables
from experiments.online.timing import step_time
from experiments.reporting.claims import evaluate, verdict_table, with_recorded
from experiments.reporting.report import Report, rows_in
from experiments.reporting.results import Results
from experiments.runner import command
from experiments.runner.cache import identity_of
from experiments.runner.stages import Found, Stages, rows_of, stages_of
from experiments.worlds.world import DT

NAME = "online"

HEAD = """\
At 4 s a simulated quadrotor changes in the air: other moments of inertia (experiment 1), a load of 20 % of its mass off
centre, a side wind, one rotor 15 % weaker, twice the drag; or nothing. The controller sees samples with noise, and its
commands arrive 10 ms later, which it and all estimators predict, as well as the lag of the rotors. Everything but the
change and the agent is the same, noise included.

- **Iris (our simulator)**: drag and ground effect; a wind of 4 N with a sine of 1 N (experiment 2); rotors lag by 30 ms
- **Hummingbird and Crazyflie (RotorPy)**: its equations with their own constants, integrated at 1 ms. Drag acts at each
  rotor and grows with its speed; the Hummingbird has translational lift and quadratic drag of its frame; the wind is
  4.5 m/s, felt by drag; rotors lag by 5 and 72 ms; there is no ground effect. The loads and inertias are of the same
  shares. Both fly the references of the Iris

The agents are the same in each world:

- **not adapted**: the rigid body of the data sheet with its drag (RotorPy: that of the rotors at hover speed, with the
  damping of rates that it causes, and the rotors' lift)
- **disturbance observer**: the same, with the constant acceleration that explains the last prediction errors
- **L1 adaptive augmentation**: the same, with the thrust and torques that a predictor finds missing added to commands
- **least squares after 10 s on the ground**: all parameters and a disturbance fitted to ten seconds of random flight
  after the change, with the same noise, known from the moment of the change on
- **online adaptation**: `hj.OnlineAdaptation`, which does not know when and what: inertia (3), centre of mass (2),
  efficiency of each rotor (4), added drag (3) and a constant force and torque (6). It knows which may change together
  (`hj.Hypothesis`): inertia; a load (mass, inertia and centre of mass); each rotor; drag; a force that may vary
- **oracle**: in our simulator the true parameters from the moment of the change on, and the wind at each moment; in
  RotorPy its own equations with the true constants and wind before and after the change

No agent but RotorPy's oracle knows what the agents' model lacks: the ground effect, which the low pass meets, drag that
grows with the rotors' speed, and quadratic drag. The true drag of RotorPy's vehicles is taken at their hover speed. A
flight crashes below the ground or 10 m off; its error then counts as infinite. The settings of filter, observer and L1
were chosen on flights of the Iris with other seeds. For RotorPy's vehicles nothing was chosen: the expected change of
drag is the same share of their own drag, that of torques of weight times arm, all else is equal.
"""


def flown(config: OnlineConfig, world: str, stages: Stages) -> Found:
    run = fly_all(config, world, stages)
    return results_of(run).rows, {"clock": np.array([run.seconds, run.processor_seconds])}


def experiment(config: OnlineConfig, console: Console) -> None:
    stages = stages_of(config, console)
    jobs = {world: partial(flown, config, world, stages) for world in config.worlds}
    described = {name: value for name, value in config.described().items() if name not in ("preset", "worlds")}
    found = stages.kept("flights", jobs, identity_of(described))
    clock = np.sum([arrays["clock"] for _, arrays in found.values()], axis=0).tolist()
    step = step_time(config.hardware("iris"), DT)
    stages.publish(NAME, config, Results(rows_of(found), TAGS), report, step_ms=step, clock=clock)


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
