"""Rows and reports of the paper's shape, and any others, for the tests of what is told."""

import math
from dataclasses import replace

import numpy as np
from hypothesis import strategies as st

from experiments.paper.claims import claims
from experiments.paper.rows import DOMAINS, MODELS, MODES, STATUSES, THETA, Row, with_rho
from experiments.reporting.report import Report
from experiments.runner.environment import environment

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


def make_rows(seeds=3, sizes=SIZES, errors=ERRORS, theta=TRUTH, domain="parameter_shift"):
    """The seeds' errors lie 2 % apart around the mean."""
    return with_rho(
        Row(
            domain,
            model,
            mode,
            n,
            seed,
            mean * (1 + 0.02 * (seed - (seeds - 1) / 2)),
            None,
            mean / 100,
            150,
            "ok",
            known,
        )
        for (model, mode), means in errors.items()
        for n, mean in means.items()
        for seed in range(seeds)
        for known in [None if model == "no_physics" else theta]
        if n in (0, *sizes)
    )


def changed(rows, model, mode, n_train, **fields):
    """The rows with a factor on `test_mse`, or other fields, changed in one cell, and ρ to match."""
    factor = fields.pop("factor", 1.0)
    cell = (model, mode, n_train)
    return with_rho(
        replace(r, **{"test_mse": r.error * factor} | fields) if (r.model, r.mode, r.n_train) == cell else r
        for r in rows
    )


def verdicts(rows, experiment="param_shift", truth=TRUTH):
    return {claim.id: claim.holds for claim in claims(rows, experiment, truth)}


def make_report(rows, experiment="param_shift", truth=TRUTH, **fields):
    judged = claims(rows, experiment, truth)
    surroundings = environment({"training": 12.5})
    return Report(experiment, {"preset": "quick", "sizes": [100]}, surroundings, rows, judged, truth, **fields)


NUMBERS = st.none() | st.floats(min_value=0) | st.sampled_from([math.nan, math.inf, np.float32(0.1)])
THETAS = st.none() | st.fixed_dictionaries({name: st.none() | st.floats() for name in THETA})
PAIRS = st.lists(st.floats(allow_nan=False), min_size=2, max_size=2).map(sorted) | st.sampled_from(
    [None, [0.0, math.nan]]
)
INTERVALS = st.none() | st.fixed_dictionaries(dict.fromkeys(THETA, PAIRS))


@st.composite
def odd_rows(draw):
    mode = draw(st.sampled_from(MODES))
    theta = draw(THETAS)
    return Row(
        domain=draw(st.sampled_from(DOMAINS)),
        model=draw(st.sampled_from(MODELS)),
        mode=mode,
        n_train=0 if mode == "source_only" else draw(st.sampled_from([1, 100, 500, 1000])),
        seed=draw(st.integers(0, 2)),
        test_mse=draw(NUMBERS),
        rho=draw(st.none() | st.floats()),
        val_mse=draw(NUMBERS),
        epochs=draw(st.integers(0, 10**6)),
        status=draw(st.sampled_from(STATUSES)),
        theta=theta,
        theta_interval=draw(INTERVALS) if theta else None,
    )


def identity(row):
    """No two rows of a report share it."""
    return row.domain, row.model, row.mode, row.n_train, row.seed


ODD_ROWS = st.lists(odd_rows(), max_size=12, unique_by=identity)
