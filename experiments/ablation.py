"""Ablations of the hybrid method, one choice at a time: python -m experiments.ablation --help"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Annotated, Any, Literal, get_args

import numpy as np
from matplotlib.figure import Figure
from rich.console import Console

from experiments.external_force import FLOOR
from experiments.paper import figures
from experiments.paper.config import QUICK, SMOKE, Config, Kind, preset_like
from experiments.paper.lanes import rows_of
from experiments.paper.study import adapted, assess, flown, pretrained, source_splits, target_splits
from experiments.paper.tables import CHOICES, ablation_tables
from experiments.reporting.names import FINE_TUNED, HYBRID, SOURCE_ONLY, label
from experiments.reporting.report import Report, rows_in, write_report
from experiments.reporting.results import Results
from experiments.reporting.statistics import Estimate, mean_interval
from experiments.reporting.tables import Table
from experiments.runner import command
from experiments.runner.options import Several, Target
from experiments.runner.run_record import record_of
from experiments.runner.stages import Stages, stages_of
from hybrid_jax.dynamics.rigid_body import nominal
from hybrid_jax.sim.domain import EXTERNAL_FORCE, PARAMETER_SHIFT, SOURCE
from hybrid_jax.sweep import hosts
from hybrid_jax.training.loss import REGULARISERS
from hybrid_jax.vehicle import IRIS

NAME = "ablation"
DOMAINS = (PARAMETER_SHIFT, EXTERNAL_FORCE)
TRUTH = {domain.name: nominal(domain.vehicle) for domain in DOMAINS}
NOTES = [
    "Seconds are those that the stages of a value took when they ran; a stage shared by several values counts in each.",
    "Off: mean of the recovered parameter over the true one, less 1.",
]
LITTLE = 0.05  # change of an error that counts as none
Choice = Literal["residual", "weight", "form", "norm", "start", "source", "noise", "solver"]

FORMS = {
    "trajectory_correlation": "correlation of trajectories",
    "inner_product": "inner product f_p · f_d",
    "cosine": "cosine of f_p and f_d",
    "pearson": "Pearson correlation of f_p and f_d",
    "residual_norm": "size of f_d",
}
NORMS = {"batch": "over the minibatch", "layer": "over the layer", "none": "none"}
SOLVERS = {"rk4": "Runge–Kutta of order 4", "heun": "Heun", "tsit5": "Tsitouras of order 5"}


@dataclass(frozen=True)
class AblationConfig(Config):
    """Change one choice of the hybrid at a time; pre-train, fine-tune and test in both experiments.

    Defaults: 3000 source trajectories, a third of the paper's, at most 400 epochs, and N = 100.
    """

    over: Several[Choice] = get_args(Choice)
    """Which choices to change. residual: what f_d sees and adds to. weight: λ. form: of the regulariser. norm: of f_d.
    start: θ_p off by 20, 50, 100 %. source: amount of source flight. noise: of the sensors. solver: the integrator."""
    sizes: Annotated[Several[int], Target] = (100,)
    """N, target trajectories to adapt to."""
    pool: int | None = 1000
    """Target trajectories from which a seed draws its N."""
    source_train: int = 3000
    """Source trajectories for pre-training."""
    max_epochs: int = 400
    """Cap, in pre-training and in fine-tuning."""


PRESETS = {
    "paper": AblationConfig(),
    "quick": preset_like(AblationConfig, QUICK, over=("residual",)),
    "smoke": preset_like(AblationConfig, SMOKE, over=("noise",), sizes=(20,), pool=20),
}


def varied(choice: str, config: Kind) -> dict[str, Kind]:
    """Map the name of each value of a choice to its configuration."""
    seen = {"all": "whole state", "no_xy": "no horizontal position", "body": "state seen from the body"}
    added = {"all": "all derivatives", "accelerations": "accelerations"}
    low, high = config.guess
    sizes = [n for n in (300, 1000, 3000, 10_000) if config.batch_size <= n < config.source_train]
    changes: dict[str, dict[str, dict[str, Any]]] = {
        "residual": {
            f"{seen[i]} → {added[o]}": {"residual_inputs": i, "residual_outputs": o} for o in added for i in seen
        },
        "weight": {f"λ = {weight:g}": {"regulariser_weight": weight} for weight in (0.0, 1e-4, 1e-3, 1e-2, 1e-1)},
        "form": {FORMS.get(form, form): {"regulariser": form} for form in (*REGULARISERS, "none")},
        "norm": {words: {"norm": norm} for norm, words in NORMS.items()},
        "start": {f"random in {low:g} to {high:g}": {"perturbed_by": None}}
        | {f"off by {off:.0%}": {"perturbed_by": off} for off in (0.2, 0.5, 1.0)},
        "source": {f"{n} trajectories": {"source_train": n} for n in (*sizes, config.source_train)},
        "noise": {f"{level:g} times the usual": {"noise": level} for level in (0.0, 0.5, 1.0, 2.0)},
        "solver": {words: {"solver": solver} for solver, words in SOLVERS.items()},
    }
    return {value: replace(config, **options) for value, options in changes[choice].items()}


def experiment(config: AblationConfig, console: Console) -> None:
    """Run every value of every choice; write the report after each choice."""
    rows = Results()
    seconds: dict[str, float] = {}
    # All configurations are made first, so that a value that contradicts another option is refused before any run.
    changed = {choice: varied(choice, config) for choice in config.over}
    for choice, values in changed.items():
        for value, other in values.items():
            console.print(f"{choice}: {value}", style="bold", highlight=False)
            stages = stages_of(config, console)
            rows += run(other, stages).tagged(choice=choice, value=value, default=other == config)
            seconds[f"{choice}, {value}"] = sum(stages.seconds.values())
        if hosts.is_main_process():
            shown = Console() if choice == config.over[-1] else None
            write_report(config.out / NAME, report(record_of(NAME, config, rows, seconds)), shown)


def run(config: AblationConfig, stages: Stages) -> Results:
    learned = pretrained(HYBRID, IRIS, config, stages, flown(SOURCE, source_splits(config), config, stages))
    rows = Results()
    for domain in DOMAINS:
        target = flown(domain, target_splits(config), config, stages)
        found = {SOURCE_ONLY: learned, FINE_TUNED: adapted(HYBRID, FINE_TUNED, learned.fields, config, stages, target)}
        rows += rows_of([assess(HYBRID, mode, config, stages, fit, target) for mode, fit in found.items()])
    return rows


def report(record: Mapping[str, Any]) -> Report:
    rows = rows_in(record)
    tables = [*ratio_table(rows), *ablation_tables(rows, TRUTH)]
    return Report(record, draw(rows), tables, conclusion(rows), notes=NOTES)


def draw(rows: Results) -> dict[str, tuple[Figure, str]]:
    drawn = {}
    for choice, group in rows.group("choice").items():
        title = f"{CHOICES[choice].capitalize()}: error over 1 s after fine-tuning"
        figure = figures.ablation(group, title, {EXTERNAL_FORCE.name: FLOOR})
        drawn[choice] = figure, f"Test errors of all seeds, by {CHOICES[choice]}"
    return drawn


def effects(rows: Results) -> dict[tuple[str, str], dict[str, Estimate]]:
    """Return the error after fine-tuning at the smallest N over the default's, by choice, value and domain.

    Geometric means over seeds, paired, with a 95 % interval without diverged seeds.
    """
    found: dict[tuple[str, str], dict[str, Estimate]] = {}
    tuned = rows.where(mode=FINE_TUNED)
    for (choice, domain), group in (
        tuned.where(n_train=min(tuned["n_train"], default=0)).group("choice", "domain").items()
    ):
        for value, ours in group.where(default=False).group("value").items() if any(group["default"]) else ():
            with np.errstate(all="ignore"):
                errors, others = np.log(ours.paired(group.where(default=True), "test_mse"))
                ends = np.exp(mean_interval(errors - others, ours["seed"]))
            found.setdefault((choice, value), {})[domain] = Estimate(*map(float, ends))
    return found


def ratio_table(rows: Results) -> list[Table]:
    """Return the effects of the first choice, of which the figure is shown: a line for each value."""
    found = {value: own for (choice, value), own in effects(rows).items() if choice == rows[0]["choice"]}
    header = (CHOICES[rows[0]["choice"]], *map(label, rows.unique("domain")))
    lines = [(value, *(each.text(".2f") for each in own.values())) for value, own in found.items()]
    return [Table("Error after fine-tuning over the default's (95 % interval)", header, lines)] if lines else []


def conclusion(rows: Results) -> list[str]:
    found = effects(rows)
    largest = {key: max(ratio.value for ratio in ratios.values()) for key, ratios in found.items()}
    better = [key for key, ratios in found.items() if all(ratio.below(1) for ratio in ratios.values())]

    def times(key: tuple[str, str]) -> str:
        ratios = ", ".join(f"{ratio.value:.2f} times ({label(domain)})" for domain, ratio in found[key].items())
        return f"“{key[1]}” ({CHOICES[key[0]]}), with {ratios}"

    sentences = []
    if better:
        others = len(better) - 1
        more = f"; {others} other value{'s are' if others > 1 else ' is'} better everywhere, too" if others else ""
        sentences.append(
            f"Best of all is {times(min(better, key=largest.__getitem__))} the error of the default{more}."
        )
    elif found:
        sentences.append("No value is better than the default in every domain.")
    if found and largest[worst := max(largest, key=largest.__getitem__)] > 1:
        sentences.append(f"What harms most is {times(worst)} the error of the default.")
    moved = {
        key[0] for key, ratios in found.items() if any(not abs(ratio.value - 1) <= LITTLE for ratio in ratios.values())
    }
    if idle := [choice for choice in dict.fromkeys(key[0] for key in found) if choice not in moved]:
        sentences.append(
            f"These choices change no error by more than {LITTLE:.0%}: {'; '.join(CHOICES[choice] for choice in idle)}."
        )
    return sentences


ABOUT = "Which choices of the method matter, and where it breaks."
main = partial(command.run, NAME, ABOUT, experiment, presets=PRESETS)

if __name__ == "__main__":
    main()
