"""Write the report, rows, figures and models of an experiment on recorded flights."""

from dataclasses import asdict
from pathlib import Path

from rich.console import Console

import hybrid_jax
from experiments.real_flight.claims import verdicts
from experiments.real_flight.figures import make_figures
from experiments.real_flight.recipes import RECIPES
from experiments.real_flight.rows import TAGS
from experiments.real_flight.study import Outputs
from experiments.real_flight.tables import page_tables, score_tables
from experiments.real_flight.train import Experiment
from experiments.reporting import report
from experiments.reporting.claims import verdict_table
from experiments.reporting.plots import save_figures
from experiments.reporting.tables import print_tables
from experiments.runner.environment import environment
from hybrid_jax.flights.splits import flight_of

NOTES = (
    "Validation flights stop every training and are not among the N windows.",
    "An interval of θ_p takes the network as given and comes from windows of 10 steps that share no sample; it does "
    "not account for errors of the model.",
)


def write_report(name: str, experiment: Experiment, outputs: Outputs, console: Console) -> None:
    """Write models, figures and, last, the report; print its main tables."""
    out, rows, stages = experiment.config.out / name, outputs.table, experiment.stages
    save_models(out / "models", experiment, outputs)
    claims = verdicts(rows)
    main = [*score_tables(rows, experiment.dt), *([verdict_table(claims, "Hypotheses")] if claims else [])]
    records = [record for logs in experiment.logs.values() for record in logs.records]
    more = page_tables(rows, outputs.choices, experiment.before, records)
    parts = ("train", "validation", "test")
    extra = {
        "vehicle": {"before": asdict(experiment.before), "after": asdict(experiment.after)},
        "folds": [
            {"tested_on": fold.name} | {part: [flight_of(log) for log in getattr(fold, part)] for part in parts}
            for fold in outputs.folds
        ],
        "choices": outputs.choices,
        "logs": {label: logs.records for label, logs in experiment.logs.items()},
    }
    figures = save_figures(out, make_figures(experiment, outputs))
    given = (experiment.config.described(), environment(stages.seconds), rows, claims, figures)
    head = introduction(name, experiment, outputs)
    report.write_report(out, report.Report(name, *given, [*stages.notes(), *NOTES], extra, head, [*main, *more]))
    print_tables(console, main)
    console.print(f"Folds, parameters and log checks: {out / 'report.md'}", highlight=False, soft_wrap=True)


def introduction(name: str, experiment: Experiment, outputs: Outputs) -> str:
    """Introduce the report to a reader who knows nothing of the experiment."""
    config, logs = experiment.config, experiment.logs
    flights = ", ".join(f"{len(each.logs)} {label}" for label, each in logs.items())
    of = ", ".join(f"{label} {sum(record['seconds'] for record in each.records):.0f} s" for label, each in logs.items())
    recipes = "\n".join(f"- recipe **{recipe}**: {RECIPES[recipe].about}" for recipe in config.tried)
    trained = (
        f"Models are trained on the source's flights, then on N windows of the target's ({config.draw}), and predict "
        if "target" in logs
        else "Models are trained on flights and predict "
    )
    return f"""# {name}

{trained}held-out flights, open loop from every sample with the recorded rotor speeds.
{flights} flights ({of}{"; simulated" if config.simulated else ""}), in {len(outputs.folds)} folds by \
{config.folds_by}; {len(outputs.rows)} tests, {config.seeds} seeds.

- **hybrid**: a multirotor that learns {", ".join(experiment.before.learn)} (or what its recipe says), plus a small \
network of body-frame inputs
- **no-physics**: the same network with ṗ = v and the attitude's kinematics
- **physics-only**: the multirotor alone
- **rigid body + linear residual**: the nominal rigid body, and a linear map of state and input fitted to its residuals
- **fine-tuned**: from the source's model; **scratch**: from nominal values; **zero-shot**: the source's model as it is
{recipes}

Errors are lengths of vectors, of rotation the angle. An RMSE is over all test windows."""


def save_models(folder: Path, experiment: Experiment, outputs: Outputs) -> None:
    """Save every trained model, with what is known about it."""
    scores = {tuple(row[tag] for tag in TAGS): row["scores"] for row in outputs.table}
    for (number, model, mode), trained in outputs.trained.items():
        fold = outputs.folds[number].name
        for run, seed in enumerate(trained.seeds):
            n = trained.size(run)
            about = {"tested_on": fold, "model": model, "mode": mode, "n_train": n, "seed": seed}
            about |= {"dt": experiment.dt, "scores": scores[fold, model, mode, n, seed]}
            name = f"fold{number}-{model}-{mode}-{n}-seed{seed}.npz"
            hybrid_jax.save(folder / name, trained.run(run), about)
