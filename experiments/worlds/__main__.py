"""Is an adapted model ever worse than its source, in worlds that we wrote and others: python -m experiments.worlds"""

from dataclasses import replace
from functools import partial
from typing import Any

from rich.console import Console

from experiments.paper.config import BOTH_ENDS, ONE_FLIGHT, SMOKE, preset_like
from experiments.reporting.claims import Claim, Part, all_of, verdict_table
from experiments.reporting.claims import evaluate as evaluate_claims
from experiments.reporting.report import Report, write_report
from experiments.reporting.results import Results
from experiments.reporting.tables import Table
from experiments.runner import command
from experiments.runner.run_record import environment
from experiments.runner.stages import stages_of
from experiments.worlds.cases import WORLDS, WorldsConfig, adapted
from hybrid_jax.sweep import hosts

NAME = "worlds"
MEAN, EACH = 1.05, 1.2  # times the source's error: in the mean of a case, and of a single adaptation
HEAD = f"""# {NAME}

A hybrid that was trained on usual flight of a vehicle adapts by `hj.adapt` to one flight after a change, or after none,
and is tested over 1 s of usual flights after it. Ratio: its test error L^T_MSE over that of the source.
"""

NOISY: dict[str, Any] = ONE_FLIGHT | {"noise_on": "all"}
PRESETS = {
    "paper": WorldsConfig(seeds=3, draws=3, noise_on="all"),
    "quick": preset_like(
        WorldsConfig,
        replace(BOTH_ENDS, **NOISY, seeds=1),
        worlds=("iris", "hummingbird"),
        changes=("nothing", "reaction_torque", "external_force", "parameter_shift"),
        learn_from=("moving", "hover", "near_ground", "outliers"),
    ),
    "smoke": preset_like(
        WorldsConfig,
        replace(SMOKE, **NOISY),
        worlds=("hummingbird",),
        changes=("nothing",),
        learn_from=("short",),
        test_flights=1,
    ),
}


def experiment(config: WorldsConfig, console: Console) -> None:
    stages = stages_of(config, console)
    rows = Results(
        [row for name in config.worlds for row in adapted(WORLDS[name], config, stages)],
        ("world", "change", "flight", "draw", "seed"),
    )
    if hosts.is_main_process():
        verdicts = evaluate_claims(CLAIMS, rows)
        report = Report(
            experiment=NAME,
            config=config.described(),
            environment=environment(stages.seconds),
            rows=rows,
            claims=verdicts,
            notes=stages.notes(),
            head=HEAD.strip(),
            conclusion=conclusion(rows),
            tables=[verdict_table(verdicts, "Hypotheses"), ratio_table(rows)],
        )
        write_report(config.out / NAME, report, Console(), config.paper)


def ratio_table(rows: Results) -> Table:
    """A line for each case, the worst first."""
    cases = sorted(rows.group("world", "change", "flight").items(), key=lambda case: -case[1].numbers("ratio").max())
    lines = []
    for case, own in cases:
        ratio, taken = own.numbers("ratio"), [row["chosen"] for row in own]
        counts = ", ".join(f"{name} {taken.count(name)}" for name in dict.fromkeys(taken))
        made_for = "yes" if own[0]["made_for"] else "no"
        lines.append((*case, made_for, f"{ratio.mean():.3g}", f"{ratio.max():.3g}", counts))
    header = ("world", "change", "flight", "candidates made for it", "mean ratio", "worst", "taken")
    return Table("Error over the source's on usual flights, the worst first", header, lines)


def conclusion(rows: Results) -> list[str]:
    """How often the law holds, and where it fails most."""
    cases = rows.group("world", "change", "flight")
    sound = [_is_sound(own) for own in cases.values()]
    (worst, own) = max(cases.items(), key=lambda case: case[1].numbers("ratio").max())
    return [
        f"In {sum(sound)} of {len(sound)} cases the adapted model is never worse than its source: at most {MEAN} times "
        f"its error in the mean, {EACH} times in a single adaptation.",
        f"The worst is {' '.join(map(str, worst))} (world, change, flight): {own.numbers('ratio').max():.3g} times.",
    ]


def _is_sound(own: Results) -> bool:
    ratio = own.numbers("ratio")
    return bool(ratio.mean() <= MEAN and ratio.max() <= EACH)


def _never_worse(rows: Results) -> Part:
    def of(case: tuple, own: Results) -> Part:
        ratio = own.numbers("ratio")
        return _is_sound(own), f"{' '.join(map(str, case))} {ratio.mean():.3g}, worst {ratio.max():.3g}"

    return all_of(of(case, own) for case, own in rows.group("world", "change", "flight").items())


CLAIMS = (
    Claim(
        "W1",
        f"In every case the adapted model errs at most {MEAN} times as much as its source in the mean, and at most "
        f"{EACH} times in each adaptation.",
        _never_worse,
    ),
)
ABOUT = "One flight in worlds that we wrote and others did: does adaptation ever make a model worse?"
main = partial(command.run, NAME, ABOUT, experiment, presets=PRESETS)

if __name__ == "__main__":
    main()
