"""What the method rests on: one choice at a time is changed, everything else stays, ten seeds each.

python -m experiments.ablation --help
"""

import json
from dataclasses import dataclass, replace
from typing import Any, Literal, get_args

import numpy as np
from rich.console import Console

from experiments.external_force import sine_floor
from experiments.paper.ablations import Trial, by_choice, figure, records, tables, to_csv
from experiments.paper.conditions import settings
from experiments.paper.config import QUICK, SMOKE, Config, Kind, distinct, preset_like
from experiments.paper.figures import save_figure
from experiments.paper.results import Lanes, rows_of, trained
from experiments.paper.rows import Row, with_rho
from experiments.paper.study import EVERY, adapted, flown, places, pretrained, source_splits, target_splits
from experiments.reporting.environment import environment
from experiments.reporting.report import print_tables
from experiments.reporting.report_page import sections
from experiments.runner import command
from experiments.runner.stages import Stages, stages_of
from hybrid_jax.dynamics.rigid_body import nominal
from hybrid_jax.io.files import json_text, json_value, write_atomic
from hybrid_jax.sim.domain import EXTERNAL_FORCE, PARAMETER_SHIFT, SOURCE
from hybrid_jax.sim.flight import DT
from hybrid_jax.sweep import hosts
from hybrid_jax.sweep.training import evaluate
from hybrid_jax.training.fitting import FitState
from hybrid_jax.training.loss import REGULARISERS
from hybrid_jax.vehicle import IRIS

NAME = "ablation"
DOMAINS = (PARAMETER_SHIFT, EXTERNAL_FORCE)
HEAD = """# ablation

One choice of the hybrid method is changed at a time, everything else stays at its default. Each value is pre-trained on
source flight and fine-tuned on N trajectories of each target: other moments of inertia (parameter shift), and a side
wind (external force).

L_MSE = (1/T) Σ_t ‖x_t − x̂_t‖²: on the source's validation windows of 0.1 s after pre-training, and on test flights of
1 s in the target, before (source-only) and after fine-tuning. Test flights are the truth, whatever the sensors' noise.
"""
NOTES = [
    "Seconds are those that the stages of a value took when they ran; one that several values share counts in each.",
    "Off: mean of the recovered parameter over the true one, less 1.",
]
Choice = Literal["residual", "weight", "form", "norm", "start", "source", "noise", "solver"]


@dataclass(frozen=True)
class AblationConfig(Config):
    """Change one choice of the hybrid at a time; pre-train, fine-tune, test in both experiments.

    Without options: 3000 source trajectories, a third of the paper's, at most 400 epochs, and N = 100.
    """

    over: tuple[Choice, ...] = get_args(Choice)
    """Which choices to change. residual: what f_d sees and adds to. weight: λ. form: of the regulariser. norm: of f_d.
    start: θ_p off by 20, 50, 100 %. source: amount of source flight. noise: of the sensors. solver: the integrator."""
    sizes: tuple[int, ...] = (100,)
    """N, target trajectories to adapt to."""
    pool: int | None = 1000
    """Target trajectories from which a seed draws its N."""
    source_train: int = 3000
    """Source trajectories for pre-training."""
    max_epochs: int = 400
    """Cap, in pre-training and in fine-tuning."""

    def __post_init__(self):
        Config.__post_init__(self)
        distinct("--over", self.over)


PRESETS = {
    "paper": AblationConfig(),
    "quick": preset_like(AblationConfig, QUICK, over=("residual",)),
    "smoke": preset_like(AblationConfig, SMOKE, over=("weight", "noise"), sizes=(20,), pool=20),
}


def variations(choice: str, config: Config) -> dict[str, dict[str, Any]]:
    """Name of each value of a choice → the options that differ from the configuration; none for the default."""
    match choice:
        case "residual":
            seen = {"all": "all of x", "no_xy": "no p_x, p_y", "body": "seen from the body"}
            added = {"all": "all 13", "accelerations": "v̇, ω̇"}
            return {
                f"{seen[i]} → {added[o]}": {"residual_inputs": i, "residual_outputs": o} for o in added for i in seen
            }
        case "weight":
            return {f"λ = {weight:g}": {"regulariser_weight": weight} for weight in (0.0, 1e-4, 1e-3, 1e-2, 1e-1)}
        case "form":
            return {form.replace("_", " "): {"regulariser": form} for form in (*REGULARISERS, "none")}
        case "norm":
            return {norm: {"norm": norm} for norm in ("batch", "layer", "none")}
        case "start":
            factors = f"random in {config.guess[0]:g} to {config.guess[1]:g}"
            return {factors: {"perturbed_by": None}} | {
                f"off by {off:.0%}": {"perturbed_by": off} for off in (0.2, 0.5, 1.0)
            }
        case "source":
            sizes = [n for n in (300, 1000, 3000, 10_000) if config.batch_size <= n < config.source_train]
            return {f"{n} trajectories": {"source_train": n} for n in (*sizes, config.source_train)}
        case "noise":
            return {f"{level:g} × typical": {"noise": level} for level in (0.0, 0.5, 1.0, 2.0)}
        case _:
            return {solver: {"solver": solver} for solver in ("rk4", "heun", "tsit5")}


def varied(choice: str, config: Kind) -> dict[str, Kind]:
    """Name of each value of a choice → the configuration with it.

    Raises:
        ValueError: a value that does not go with the other options.
    """
    return {value: replace(config, **changes) for value, changes in variations(choice, config).items()}


def experiment(config: AblationConfig, console: Console) -> None:
    """Run every value of every choice and write what came of it, after each choice."""
    trials: list[Trial] = []
    seconds: dict[str, float] = {}
    # Made before the first one runs: a value that does not go with the other options is refused at once.
    changed = {choice: varied(choice, config) for choice in config.over}
    for choice, values in changed.items():
        for value, other in values.items():
            console.print(f"{choice}: {value}", style="bold", highlight=False)
            stages = stages_of(config, console)
            trials.append(tried(choice, value, other, config, stages))
            seconds[f"{choice}, {value}"] = sum(stages.seconds.values())
        if hosts.is_main_process():
            write(config, trials, seconds)
    if hosts.is_main_process():
        print_tables(Console(), tables(trials, truth()))


def tried(choice: str, value: str, config: AblationConfig, default: AblationConfig, stages: Stages) -> Trial:
    """The hybrid, pre-trained and fine-tuned under a changed configuration."""
    source = flown(SOURCE, source_splits(config), config, stages)
    shared = settings(config)
    learned = pretrained("hybrid", IRIS, config, stages, source)
    rows: list[Row] = []
    for domain in DOMAINS:
        target = flown(domain, target_splits(config), config, stages)
        final = adapted("hybrid", "fine_tuned", learned.best, config, stages, target)

        def lanes(mode: str, sizes, found: FitState, target=target) -> Lanes:
            errors = evaluate(found.best, target.splits["test"], EVERY, shared)
            return trained("hybrid", mode, *places(sizes, config), found, errors)

        both = (lanes("source_only", (0,), learned), lanes("fine_tuned", config.sizes, final))
        rows += with_rho([row for group in both for row in rows_of(group, domain.name)])
    return Trial(choice, value, config == default, [float(mse) for mse in learned.best_mse], rows)


def truth() -> dict[str, dict[str, float]]:
    """The true θ_p of each domain."""
    return {domain.name: nominal(domain.vehicle) for domain in DOMAINS}


def write(config: AblationConfig, trials: list[Trial], seconds: dict[str, float]) -> None:
    """All that is known so far: the figure of each choice, report.json, rows.csv, report.md."""
    out = config.out / NAME
    floors = {EXTERNAL_FORCE.name: sine_floor(IRIS.mass, DT * np.arange(EVERY, 101, EVERY))}
    for choice, group in by_choice(trials).items():
        title = f"{choice.capitalize()}: test error over 1 s after fine-tuning"
        save_figure(figure(group, title, floors), out / choice)
    for name, content in contents(config, trials, environment(seconds)).items():
        write_atomic(out / name, content)


def contents(config: AblationConfig, trials: list[Trial], where: dict[str, Any]) -> dict[str, str]:
    """The text of each file."""
    used = json_value(config.described())
    captions = {f"{choice}.png": f"Test errors of all seeds, by {choice}" for choice in by_choice(trials)}
    record = {
        "experiment": NAME,
        "config": used,
        "environment": where,
        "rows": records(trials),
        "claims": [],
        "figures": captions,
        "notes": NOTES,
    }
    shown = json.dumps(used, indent=1, ensure_ascii=False)
    page = sections(HEAD.strip(), tables(trials, truth()), captions, NOTES, json_value(where), shown)
    return {"rows.csv": to_csv(trials), "report.md": page, "report.json": json_text(json_value(record))}


def main() -> None:
    """The command line."""
    about = "What matters, what does not, and where the method breaks."
    command.run(NAME, about, experiment, presets=PRESETS)


if __name__ == "__main__":
    main()
