"""Recipes: their losses, and which parameters each of their stages trains."""

from dataclasses import replace

import equinox as eqx
import jax
import numpy as np
import pytest
from recorded import CONFIG, LOGS

from experiments.real_flight import models
from experiments.real_flight.config import LEARN
from experiments.real_flight.folds import make_folds
from hybrid_jax.dynamics.baselines import Kinematics
from hybrid_jax.dynamics.vehicle_file import VehicleModel
from hybrid_jax.flights.windows import cut_windows
from hybrid_jax.state import POSITION
from hybrid_jax.sweep.lanes import count, lane
from hybrid_jax.training.stages import rates_by_group
from hybrid_jax.vehicle import IRIS

MODEL = VehicleModel(IRIS, learn=LEARN)


def objective(recipe):
    windows = cut_windows(make_folds(LOGS, None, CONFIG)[0].train, 5, 2).windows
    return models.objective_of(MODEL, windows, recipe)


def test_position_factor_scales_position_errors_alone():
    one, ten = (objective(replace(models.RECIPES["staged"], position=factor)).channels for factor in (1.0, 10.0))
    assert (one[0].start, one[0].stop) == (POSITION.start, POSITION.stop)
    assert ten == (replace(one[0], scale=10 * one[0].scale), *one[1:])


def test_huber_threshold_changes_nothing_else_of_the_loss():
    square, linear = (objective(models.RECIPES[name]) for name in ("staged", "frozen_rates"))
    assert linear == replace(square, huber=models.RECIPES["frozen_rates"].huber)
    assert linear.huber < square.huber


@pytest.mark.parametrize("model", ["hybrid", "no_physics", "physics_only"])
def test_equivalent_recipe_trains_the_model_in_the_same_way(model):
    names = tuple(models.RECIPES)
    for recipe in names:
        first = models.equivalent_recipe(model, recipe, names)
        assert eqx.tree_equal(*(models.untrained(model, MODEL, models.RECIPES[name], 4, 1) for name in (first, recipe)))
        assert (models.RECIPES[first].source, models.RECIPES[first].window) == (
            models.RECIPES[recipe].source,
            models.RECIPES[recipe].window,
        )
    assert models.equivalent_recipe(model, "turning", names) == ("turning" if model == "hybrid" else "staged")
    assert models.equivalent_recipe(model, "turning", ("turning", "staged")) == "turning"
    assert models.equivalent_recipe(model, "short", names) == "short"


@pytest.mark.parametrize("recipe", models.RECIPES)
@pytest.mark.parametrize("model", ["hybrid", "no_physics", "physics_only"])
def test_untrained_models_equal_their_physics_and_stages_train_them(model, recipe):
    fields = models.untrained(model, MODEL, models.RECIPES[recipe], 4, 2)
    assert count(fields) == 2
    one = lane(fields, 0)
    x, u = LOGS[0].x[0].astype(np.float32), LOGS[0].u[0].astype(np.float32)
    physics = Kinematics() if model == "no_physics" else models.physics_of(MODEL, models.RECIPES[recipe])
    np.testing.assert_allclose(one(x, u), physics(x, u), rtol=1e-6)
    for step in (*models.RECIPES[recipe].source, *models.RECIPES[recipe].adaptation, *models.RECIPES[recipe].scratch):
        rates = jax.tree.leaves(rates_by_group(one, models.rates_of(step, model, one)))
        assert any(rate > 0 for rate in rates) == (model != "physics_only" or step.physics > 0)
        assert step.steps <= models.RECIPES[recipe].window


def test_parameters_survive_a_change_of_vehicle():
    heavier = replace(IRIS, mass=2.0)
    fields = models.untrained("hybrid", MODEL, models.RECIPES["staged"], 4, 2)
    fields = eqx.tree_at(lambda f: f.physics.deviations["drag"], fields, np.full((2, 3), 0.1, np.float32))
    moved = models.move_to_vehicle(fields, heavier)
    for index in range(2):
        before, after = (models.body_of(lane(each, index)).theta() for each in (fields, moved))
        for name, value in before.items():
            np.testing.assert_allclose(after[name], value, rtol=1e-5)
    assert moved.physics.vehicle == heavier


def test_adaptation_freezes_the_velocity_gain():
    fields = models.untrained(
        "hybrid", replace(MODEL, learn=("drag", "velocity_gain", "velocity_lag")), models.RECIPES["staged"], 4, 1
    )
    one = lane(fields, 0)
    for step in models.RECIPES["staged"].adaptation:
        rates = rates_by_group(one, models.rates_of(step, "hybrid", one)).physics.deviations
        assert {name for name, rate in rates.items() if rate == 0} == {"velocity_gain"}
