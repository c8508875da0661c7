"""Rows and reports of the paper's shape, and random ones, for the tests of reporting."""

from types import MappingProxyType

from experiments.paper.claims import claims
from experiments.paper.config import PRESETS
from experiments.paper.lanes import TAGS, with_rho
from experiments.paper.outcome import paper_report
from experiments.reporting.results import Results
from experiments.runner.run_record import record_of

TRUTH = {"Ix": 0.04, "Iy": 0.02, "k": 8.5e-6}
SIZES = (100, 500, 1000)
# Mean test errors as in the paper: every claim holds.
ERRORS = {
    ("hybrid", "source_only"): {0: 2.6},
    ("no_physics", "source_only"): {0: 2.3},
    ("hybrid", "fine_tuned"): {100: 0.022, 500: 0.018, 1000: 0.016},
    ("hybrid", "target_only"): {100: 0.14, 500: 0.019, 1000: 0.0161},
    ("no_physics", "fine_tuned"): {100: 2.9, 500: 1.6, 1000: 1.2},
    ("no_physics", "target_only"): {100: 9.0, 500: 2.0, 1000: 1.2},
}


def row(model, mode, n, seed, test_mse, domain="parameter_shift", theta=None, **fields):
    known = {"domain": domain, "model": model, "mode": mode, "n_train": n, "seed": seed, "test_mse": test_mse}
    known |= {"draw": 0, "rho": None, "val_mse": 1e-3, "epochs": 150, "status": "ok"}
    return known | {"theta": theta} | fields


def make_rows(seeds=3, sizes=SIZES, errors=ERRORS, theta=TRUTH, domain="parameter_shift"):
    """The seeds' errors lie 2 % apart around the mean."""
    rows = [
        row(model, mode, n, seed, mean * (1 + 0.02 * (seed - (seeds - 1) / 2)), domain, known)
        for (model, mode), means in errors.items()
        for n, mean in means.items()
        for seed in range(seeds)
        for known in [None if model == "no_physics" else theta]
        if n in (0, *sizes)
    ]
    return with_rho(Results(rows, TAGS))


def changed(rows, model, mode, n_train, factor=1.0, **fields):
    """The rows with a factor on `test_mse`, or other fields, changed in one cell, and ρ to match."""
    cell = {"model": model, "mode": mode, "n_train": n_train}

    def change(row):
        scaled = None if row["test_mse"] is None else row["test_mse"] * factor
        return {**row, "test_mse": scaled, **fields} if cell.items() <= row.items() else row

    return with_rho(Results([change(row) for row in rows], rows.tags))


def verdicts(rows, experiment="param_shift", truth=TRUTH):
    return {verdict.id: verdict.holds for verdict in claims(rows, experiment, truth)}


def make_report(rows, experiment="param_shift", figures=MappingProxyType({}), notes=(), **extra):
    record = record_of(experiment, PRESETS["paper"], rows, {"training": 12.5}, notes, truth_theta=TRUTH, **extra)
    return paper_report(record, rows, figures)
