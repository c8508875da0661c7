"""The presets and ablations are the tables of the paper, and lanes and flights are what these tables say."""

import math
from dataclasses import replace
from functools import partial
from typing import get_args

import equinox as eqx
import jax
import numpy as np
import pytest
from rich.console import Console
from surface import refusal

from experiments import ablation
from experiments.make_flights import chosen_flights
from experiments.paper.conditions import adaptation, fresh_fields, measured, pretraining, subsets
from experiments.paper.config import PAPER, PRESETS, AdaptationConfig, Stopping, column
from experiments.paper.study import drawn_splits, placeholder, pretrained
from hybrid_jax import IRIS, Hybrid, Trajectories
from hybrid_jax.io import Dataset, save_dataset
from hybrid_jax.sim import PARAMETER_SHIFT, SOURCE, SplitSpec
from hybrid_jax.sweep import lane
from hybrid_jax.vehicle import SENSOR_NOISE

# The paper's tables, written down a second time: N → (rate of θ_d, minimum, patience).
HYBRID = {100: (1e-3, 100, 20), 300: (1e-4, 300, 50), 500: (1e-4, 300, 50), 700: (1e-4, 300, 50), 1000: (1e-3, 100, 20)}
NO_PHYSICS = {n: (1e-5 if n == 1000 else 1e-4, 250, 50) for n in HYBRID}
NO_PHYSICS_TARGET_ONLY = dict.fromkeys(HYBRID, (1e-4, 250, 50))
SMALL = replace(PAPER, seeds=3, hidden=4)


def plans_by_lane(model, mode):
    """[(N, seed, plan)] in the order of the lanes."""
    states, plans = adaptation(model, mode, fresh_fields(model, IRIS, SMALL), SMALL, SMALL.sizes)
    lanes = [(n, seed) for n in SMALL.sizes for seed in range(SMALL.seeds)]
    assert len(states.epoch) == len(lanes)
    return [(n, seed, lane(plans, i)) for i, (n, seed) in enumerate(lanes)]


def numbers(plan):
    return int(plan.n_train), int(plan.min_epochs), int(plan.patience), int(plan.max_epochs)


def test_the_paper_preset_is_the_paper():
    paper = PRESETS["paper"]
    assert paper.sizes == (100, 300, 500, 700, 1000)
    assert (paper.seeds, paper.hidden, paper.batch_size, paper.max_epochs) == (10, 64, 100, 2000)
    assert (paper.source_train, paper.validation, paper.n_test) == (10_000, 1000, 1000)
    assert (paper.regulariser, paper.regulariser_weight, paper.solver) == ("trajectory_correlation", 1e-3, "rk4")
    assert paper.guess == (0.8, 1.25)
    assert paper == AdaptationConfig()  # no preset means the paper
    # A size between two columns takes the nearest by ratio.
    assert [column(n) for n in (1, 100, 170, 180, 300, 600, 700, 1000, 50_000)] == [0, 0, 0, 1, 1, 3, 3, 4, 4]
    assert all(preset.preset == name for name, preset in PRESETS.items())


@pytest.mark.parametrize(
    ("model", "mode", "table"),
    [
        ("hybrid", "fine_tuned", HYBRID), ("hybrid", "target_only", HYBRID), ("no_physics", "fine_tuned", NO_PHYSICS),
        ("no_physics", "target_only", NO_PHYSICS_TARGET_ONLY), ("physics_only", "fine_tuned", HYBRID),
    ],
)  # fmt: skip
def test_runs_have_the_table_s_rates_and_patience(model, mode, table):
    for n, _, plan in plans_by_lane(model, mode):
        rate, *rule = table[n]
        assert numbers(plan) == (n, *rule, 2000)
        expected = {"hybrid": [1e-2, rate], "no_physics": [rate], "physics_only": [1e-2]}[model]
        np.testing.assert_allclose(jax.tree.leaves(plan.rates), expected, rtol=1e-6)  # float32
        np.testing.assert_allclose(plan.regulariser_weight, 1e-3, rtol=1e-6)


@pytest.mark.parametrize(
    ("model", "rule", "rates"),
    [("hybrid", (100, 20), [1e-2, 1e-4]), ("no_physics", (300, 50), [1e-4]), ("physics_only", (100, 20), [1e-2])],
)
def test_pretraining_lanes_use_all_source_flights(model, rule, rates):
    _, plans = pretraining(model, fresh_fields(model, IRIS, SMALL), SMALL)
    for plan in map(partial(lane, plans), range(SMALL.seeds)):
        assert numbers(plan) == (10_000, *rule, 2000)
        np.testing.assert_array_equal(np.sort(plan.subset), np.arange(10_000))
        np.testing.assert_allclose(jax.tree.leaves(plan.rates), rates, rtol=1e-6)


def test_pretraining_goes_on_from_the_best_with_all_rates_times_each_decay():
    config = replace(SMALL, rates=replace(SMALL.rates, decay=(0.1, 0.01)))
    begun = []

    class Trained:
        def sweep(self, name, states, plans, *_):
            begun.append((states.field, plans.rates))
            return eqx.tree_at(lambda state: state.best, states, jax.tree.map(lambda leaf: leaf + 1, states.field))

    found = pretrained("hybrid", IRIS, config, Trained(), None)
    fields, rates = zip(*begun, strict=True)
    for field, before in zip((*fields[1:], found.fields), fields, strict=True):
        assert eqx.tree_equal(field, jax.tree.map(lambda leaf: leaf + 1, before))
    for each, factor in zip(rates, (1, 0.1, 0.01), strict=True):
        np.testing.assert_allclose(each.physics, factor * 1e-2, rtol=1e-6)
        np.testing.assert_allclose(each.residual, factor * 1e-4, rtol=1e-6)


def test_subsets_are_nested_by_size_and_differ_by_seed_and_contiguous_ones_are_starts_of_flights():
    of_hybrid = {(n, seed): plan.subset for n, seed, plan in plans_by_lane("hybrid", "fine_tuned")}
    for (n, seed), subset in of_hybrid.items():
        np.testing.assert_array_equal(np.sort(subset), np.arange(1000))
        # One order a seed; a size takes its first N: nested.
        np.testing.assert_array_equal(subset, of_hybrid[100, seed], err_msg=f"N = {n}")
    assert not np.array_equal(of_hybrid[100, 0], of_hybrid[100, 1])
    for n, seed, plan in plans_by_lane("no_physics", "target_only"):
        np.testing.assert_array_equal(plan.subset, of_hybrid[n, seed])
    # Other random draws leave the first as it was.
    one, two = subsets(SMALL), subsets(replace(SMALL, draws=2))
    np.testing.assert_array_equal(two[: SMALL.seeds], one)
    assert len(np.unique(two, axis=0)) == 2 * SMALL.seeds
    config = replace(SMALL, draw="contiguous", draws=2, sizes=(100, 300))
    drawn, spec = subsets(config).reshape(2, SMALL.seeds, -1), drawn_splits(config)["train"]
    flight = np.arange(spec.windows) // (spec.windows // spec.flights)
    assert (drawn == drawn[:, :1]).all()
    np.testing.assert_array_equal(drawn[0, 0, :100], np.arange(100))  # ten seconds of one flight
    assert len({*flight[drawn[0, 0, :300]]}) == 3
    assert not {*flight[drawn[0, 0]]} & {*flight[drawn[1, 0]]}


def test_own_validation_windows_are_of_the_n_and_not_trained_on():
    config = replace(SMALL, validation="own")
    assert "validation" not in drawn_splits(config)
    fields = fresh_fields("hybrid", IRIS, config)
    _, plans = adaptation("hybrid", "fine_tuned", fields, config, [100])
    for plan, subset in zip(map(partial(lane, plans), range(config.seeds)), subsets(config), strict=True):
        trained = plan.subset[: plan.n_train]
        assert (len(trained), len(plan.validate_on)) == (80, 20)
        np.testing.assert_array_equal(np.concatenate([trained, plan.validate_on]), subset[:100])


def test_a_seed_gives_all_models_the_same_parts_and_lanes_start_from_their_own_seed_s_field():
    fields = {model: fresh_fields(model, IRIS, SMALL) for model in ("hybrid", "no_physics", "physics_only")}
    assert isinstance(fields["hybrid"], Hybrid)
    assert eqx.tree_equal(fields["hybrid"].residual, fields["no_physics"])
    assert eqx.tree_equal(fields["hybrid"].physics, fields["physics_only"])
    for leaf in (fields["no_physics"].weight_in, fields["physics_only"].deviations["Ix"]):
        assert len(np.unique(leaf, axis=0)) == SMALL.seeds
    factors = np.exp(list(fields["physics_only"].deviations.values()))
    assert ((factors >= 0.8) & (factors <= 1.25)).all()
    fields = fresh_fields("no_physics", IRIS, SMALL)
    states, _ = adaptation("no_physics", "fine_tuned", fields, SMALL, SMALL.sizes)
    for i in range(len(SMALL.sizes) * SMALL.seeds):
        np.testing.assert_array_equal(states.field.weight_in[i], fields.weight_in[i % SMALL.seeds])
    # A seed fixes the order of minibatches; the seeds' orders differ.
    assert len(np.unique(states.key, axis=0)) == SMALL.seeds


REFUSED = [
    *(({"sizes": sizes}, "--n-target") for sizes in ((10,), (), (100, 100))),
    ({"sizes": (9,), "batch_size": 9}, "constant_disturbance"), ({"models": ()}, "--models"),
    ({"batch_size": 1}, "--batch-size must be at least 2 with --norm batch, got 1"),
    ({"source_train": 50}, "--source-train"), ({"seeds": 0}, "--seeds"),
    *(({"guess": box}, "--init-range must be two factors") for box in ((1.2, 0.8), (-1.0, 0.8), (0.8, math.inf))),
    ({"noise": math.inf}, "--noise must be a finite number of at least 0, got inf"),
    ({"draw": "contiguous", "pool": 2000}, "--pool is for --sampling random: leave it out"),
    ({"rates": replace(PAPER.rates, hybrid=(1e-3,))}, "--rates.hybrid"),
    ({"rates": replace(PAPER.rates, no_physics=(1e-4,) * 4 + (math.nan,))}, "--rates.no-physics must be a finite"),
    ({"patience": replace(PAPER.patience, no_physics=Stopping(-1, 5))}, "--patience.no-physics.minimum must be"),
]  # fmt: skip


@pytest.mark.parametrize(("change", "named"), REFUSED, ids=str)
def test_options_that_do_not_fit_are_refused_by_name(change, named):
    with pytest.raises(ValueError, match=named):
        replace(PAPER, **change)


@pytest.mark.parametrize("choice", get_args(ablation.Choice))
def test_every_choice_has_its_default_once(choice):
    config = ablation.PRESETS["paper"]
    changed = list(ablation.varied(choice, config).values())
    assert changed.count(config) == 1
    assert len({str(other) for other in changed}) == len(changed) > 2


def test_contradictory_values_are_refused_before_any_flight(tmp_path):
    config = replace(ablation.PRESETS["smoke"], batch_size=1, norm="none", over=("weight", "norm"), out=tmp_path)
    refusal(lambda: ablation.experiment(config, Console(quiet=True)), "--batch-size must be at least 2 with --norm")
    assert not list(tmp_path.iterdir())


def test_noise_has_its_size_spares_the_test_split_and_is_one_for_both_windows_that_share_a_sample():
    x = np.zeros((400, 10, 13), np.float32)
    x[..., 3] = 1
    clean = Trajectories(x[:, 0], np.zeros((400, 10, 4), np.float32), x, 0.01)
    noisy = measured(Dataset({"train": clean, "test": clean}, {}), 2.0, seed=0)
    np.testing.assert_array_equal(noisy.splits["test"].x, x)
    off = noisy.splits["train"].x - x
    # 4000 draws of a normal: its spread is known to 1.1 %.
    np.testing.assert_allclose(off[..., 0].std(), 2 * SENSOR_NOISE[0], rtol=0.05)
    np.testing.assert_allclose(off[..., 12].std(), 2 * SENSOR_NOISE[3], rtol=0.05)
    np.testing.assert_allclose(np.linalg.norm(noisy.splits["train"].x0[:, 3:7], axis=1), 1, rtol=1e-6)
    windows = placeholder(SplitSpec(6, 10, flights=2))
    chained = replace(windows, x=windows.x + np.arange(6)[:, None, None], x0=windows.x0 - 1)
    chained.x0[[1, 2, 4, 5]] = chained.x[[0, 1, 3, 4], -1]
    noisy = measured(Dataset({"train": chained}, {}), 1.0, 0).splits["train"]
    np.testing.assert_array_equal(noisy.x0[[1, 2, 4, 5]], noisy.x[[0, 1, 3, 4], -1])
    assert (noisy.x0[[0, 3], :3] != chained.x0[[0, 3], :3]).all()


@pytest.fixture
def file(tmp_path):
    path, flights = tmp_path / "flights.npz", placeholder(SplitSpec(8, 10))
    flights.x[..., 0] = np.arange(8)[:, None]
    save_dataset(path, Dataset({"train": flights}, {"config": SOURCE.describe() | {"seed": 3}}))
    return path


def test_the_first_windows_are_taken_so_that_sizes_are_nested(file):
    few = chosen_flights(file, SOURCE, {"train": SplitSpec(3, 10)}).splits["train"]
    more = chosen_flights(file, SOURCE, {"train": SplitSpec(8, 10)}).splits["train"]
    assert (len(few), len(more)) == (3, 8)
    np.testing.assert_array_equal(few.x, more.x[:3])


@pytest.mark.parametrize(
    ("domain", "splits", "said"),
    [
        (SOURCE, {"train": SplitSpec(9, 10)}, "9 windows of split 'train' requested, but it has 8"),
        (SOURCE, {"test": SplitSpec(1, 100)}, "has no split 'test'"),
        (SOURCE, {"train": SplitSpec(3, 20)}, "split 'train' has windows of 10 steps, expected 20"),
        (PARAMETER_SHIFT, {"train": SplitSpec(3, 10)}, 'domain is "source", expected "parameter_shift"'),
    ],
)
def test_what_the_file_does_not_have_is_refused_in_one_line(file, domain, splits, said):
    refusal(lambda: chosen_flights(file, domain, splits), file, said)
