"""Every method adapts the same source model (paper, Sec. 4.7, Table 2): python -m experiments.comparison --help"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Annotated, Any, get_args

import numpy as np
from rich.console import Console

from experiments.external_force import sine_floor
from experiments.paper.claims import COMPARISON
from experiments.paper.conditions import augmentation, settings
from experiments.paper.config import QUICK, SMOKE, TABLE_SIZES, AllModels, Config, Encoding, Stopping, preset_like
from experiments.paper.expert_augmentation import Augmentation
from experiments.paper.figures import ranking
from experiments.paper.lanes import Fit, fit_of, rows_of, save_models, source_of
from experiments.paper.methods import PAST, Case, Method, adapted, source_only
from experiments.paper.outcome import FLOOR, paper_report
from experiments.paper.study import drawn_splits, flown, pretrained, source_splits
from experiments.reporting.names import EXPERT_AUGMENTATION, HYBRID, LAST_LAYER
from experiments.reporting.report import Report, rows_in
from experiments.reporting.results import Results
from experiments.runner import command
from experiments.runner.options import Several, Target, factors
from experiments.runner.stages import Stages, stages_of
from hybrid_jax.dynamics.rigid_body import LEARNED, nominal
from hybrid_jax.io.datasets import Dataset
from hybrid_jax.sim.domain import EXTERNAL_FORCE, PARAMETER_SHIFT, SOURCE
from hybrid_jax.sim.flight import DT, SplitSpec
from hybrid_jax.sweep import hosts
from hybrid_jax.trajectories import split
from hybrid_jax.vehicle import IRIS

NAME, TITLE = COMPARISON, "Adapting with 100 trajectories, tested over 0.1 s"
DOMAINS = (PARAMETER_SHIFT, EXTERNAL_FORCE)


@dataclass(frozen=True)
class ComparisonConfig(AllModels):
    """Adapt one pre-trained model by every method with N trajectories, and test predictions over 0.1 s."""

    sizes: Annotated[Several[int], Target] = (100,)
    """N, target trajectories to adapt to; rates and patience are those of the nearest size in the paper's table."""
    methods: Several[Method] = get_args(Method)
    """Methods to compare."""
    encoding: Encoding = field(default_factory=Encoding)

    def pooled(self) -> int:
        """By default the pool of the experiments' largest N, so that a seed draws the same N."""
        if self.draw == "random" and self.pool is None:
            return max(*TABLE_SIZES, *self.sizes)
        return Config.pooled(self)

    def __post_init__(self):
        Config.__post_init__(self)
        if min(self.sizes) <= len(LEARNED):
            raise ValueError(f"--n-target must each be more than the {len(LEARNED)} of θ_p, got {self.sizes}")
        factors("--encoding.box", self.encoding.box)
        if LAST_LAYER in self.methods and (self.residual_inputs, self.residual_outputs) != ("all", "all"):
            raise ValueError("--methods last_layer needs a residual that sees and writes the whole state")


PRESETS = {
    "paper": ComparisonConfig(),
    "quick": preset_like(ComparisonConfig, QUICK, encoding=Encoding(stopping=Stopping(20, 10))),
    "smoke": preset_like(ComparisonConfig, SMOKE, sizes=(20,), pool=20, encoding=Encoding(hidden=8)),
}


def experiment(config: ComparisonConfig, console: Console) -> None:
    stages = stages_of(config, console)
    learned, experts = source_models(config, stages)
    out, rows, flights = config.out / NAME, Results(), dict[str, Any]()
    for domain in DOMAINS:
        target = flown(domain, drawn_splits(config) | past_splits(test=config.n_test), config, stages)
        case = Case(config, stages, learned, experts, target)
        lanes = [source_only(case, model) for model in learned]
        lanes += [adapted(case, method) for method in config.methods]
        found = rows_of(lanes)
        if hosts.is_main_process():
            save_models(out / "models" / domain.name, lanes, found)
        rows, flights = rows + found, flights | {domain.name: target.metadata}
    floor = sine_floor(IRIS.mass, DT * np.arange(1, PAST + 1))
    extra = {"truth_theta": {each.name: nominal(each.vehicle) for each in DOMAINS}, FLOOR: floor, "flights": flights}
    stages.publish(NAME, config, rows, report, **extra)


def report(record: Mapping[str, Any]) -> Report:
    rows, caption = rows_in(record), "Test errors of all seeds of every method (paper, Table 2)"
    standings = ranking(rows, TITLE, {EXTERNAL_FORCE.name: record[FLOOR]})
    return paper_report(record, rows, {"standings": (standings, caption)})


def source_models(config: ComparisonConfig, stages: Stages) -> tuple[dict[str, Fit], Fit | None]:
    source = flown(SOURCE, source_splits(config), config, stages)
    models = dict.fromkeys([HYBRID, *map(source_of, config.methods)])
    learned = {model: pretrained(model, IRIS, config, stages, source) for model in models}
    if EXPERT_AUGMENTATION not in config.methods:
        return learned, None
    with_past = past_splits(train=config.source_train, validation=config.validating())
    longer = flown(SOURCE, with_past, config, stages)
    renamed = Dataset({name.removesuffix("_with_past"): longer.splits[name] for name in with_past}, longer.metadata)
    past, _ = split(renamed.splits["train"], PAST)
    learning = replace(settings(config), objective=Augmentation(PAST))
    lanes = augmentation(learned[HYBRID].fields, past, config.encoding, config)
    return learned, fit_of(stages.sweep("expert augmentation", *lanes, learning, renamed))


def past_splits(**windows: int) -> dict[str, SplitSpec]:
    """Return splits with the past that an encoder reads: `train=1000` becomes `train_with_past`."""
    return {f"{name}_with_past": SplitSpec(count, 2 * PAST) for name, count in windows.items()}


ABOUT = "Ten ways to adapt to ten seconds of flight, in both experiments (Table 2)."
main = partial(command.run, NAME, ABOUT, experiment, presets=PRESETS)

if __name__ == "__main__":
    main()
