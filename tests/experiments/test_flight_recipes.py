"""Recipes: what each minimises, what of a model each of their steps moves, and what it leaves as it was."""

from dataclasses import replace

import equinox as eqx
import jax
import numpy as np
import pytest
from recorded import CONFIG, LOGS, OTHERS

from experiments.real_flight import train
from experiments.real_flight.folds import folds_of, lessons
from experiments.real_flight.models import Craft, fresh, moved, rates_of, settings_of
from experiments.real_flight.recipes import RECIPES, alike, stage_of
from experiments.real_flight.scoring import body_of
from experiments.real_flight.train import Course
from hybrid_jax.dynamics.kinematics import Kinematics
from hybrid_jax.dynamics.terms import Terms
from hybrid_jax.state import POSITION
from hybrid_jax.sweep.lanes import count, lane
from hybrid_jax.training.stages import rates_by_group
from hybrid_jax.vehicle import IRIS

CRAFT = Craft(IRIS, Terms())


def test_weights_of_channels_come_from_training_windows_alone():
    """The same with other validation and test flights."""
    fold = folds_of(LOGS, None, CONFIG)[0]
    other = replace(fold, validation=OTHERS[:2], test=OTHERS[2:])
    one, two = (settings_of(CRAFT, lessons(each, 5, 2, 10), RECIPES["staged"], 100) for each in (fold, other))
    assert one.objective == two.objective


def test_a_recipe_says_how_little_position_counts_and_nothing_else_changes():
    few = lessons(folds_of(LOGS, None, CONFIG)[0], 5, 2, 10)
    recipes = (replace(RECIPES["staged"], position=factor) for factor in (1.0, 10.0))
    one, ten = (settings_of(CRAFT, few, recipe, 100).objective.channels for recipe in recipes)
    assert (one[0].start, one[0].stop) == (POSITION.start, POSITION.stop)
    assert ten == (replace(one[0], scale=10 * one[0].scale), *one[1:])


def test_a_recipe_says_from_where_errors_count_linearly_and_nothing_else_changes():
    few = lessons(folds_of(LOGS, None, CONFIG)[0], 5, 2, 10)
    square, linear = (settings_of(CRAFT, few, RECIPES[name], 100).objective for name in ("staged", "frozen_rates"))
    assert linear == replace(square, huber=RECIPES["frozen_rates"].huber)
    assert linear.huber < square.huber


@pytest.mark.parametrize("model", ["hybrid", "no_physics", "physics_only"])
def test_what_recipes_train_alike_is_trained_by_the_first(model):
    names = tuple(RECIPES)
    for recipe in names:
        first = alike(model, recipe, names)
        assert eqx.tree_equal(*(fresh(model, CRAFT, RECIPES[name], 4, 1) for name in (first, recipe)))
        assert (RECIPES[first].source, RECIPES[first].window) == (RECIPES[recipe].source, RECIPES[recipe].window)
    assert alike(model, "turning", names) == ("turning" if model == "hybrid" else "staged")
    assert alike(model, "turning", ("turning", "staged")) == "turning"
    assert alike(model, "short", names) == "short"


@pytest.mark.parametrize("recipe", RECIPES)
@pytest.mark.parametrize("model", ["hybrid", "no_physics", "physics_only"])
def test_every_model_begins_as_its_physics_and_every_step_of_its_own_moves_it(model, recipe):
    fields = fresh(model, CRAFT, RECIPES[recipe], 4, 2)
    assert count(fields) == 2
    one = lane(fields, 0)
    x, u = LOGS[0].x[0].astype(np.float32), LOGS[0].u[0].astype(np.float32)
    begin = Kinematics() if model == "no_physics" else CRAFT.physics(RECIPES[recipe])
    np.testing.assert_allclose(one(x, u), begin(x, u), rtol=1e-6)
    for step in (*RECIPES[recipe].source, *RECIPES[recipe].adaptation, *RECIPES[recipe].scratch):
        rates = jax.tree.leaves(rates_by_group(one, stage_of(step, model).rates))
        assert any(rate > 0 for rate in rates) == (model != "physics_only" or step.physics > 0)
        assert step.steps <= RECIPES[recipe].window


def test_a_model_that_is_carried_over_keeps_its_parameters():
    heavier = replace(IRIS, mass=2.0)
    fields = fresh("hybrid", CRAFT, RECIPES["staged"], 4, 2)
    fields = eqx.tree_at(lambda f: f.physics.deviations["drag"], fields, np.full((2, 3), 0.1, np.float32))
    carried = moved(fields, heavier)
    for index in range(2):
        was, now = (body_of(lane(each, index)).theta() for each in (fields, carried))
        for name, value in was.items():
            np.testing.assert_allclose(now[name], value, rtol=1e-5)
    assert carried.physics.vehicle == heavier


@pytest.mark.parametrize("changes", [True, False])
def test_what_only_a_change_brings_is_learned_where_it_is_there(changes, monkeypatch):
    """Before a load there is no cable; where nothing is adapted, one may have been there all along."""
    monkeypatch.setattr(train, "in_stages", lambda _name, _model, _fields, _lanes, steps, *_: steps)
    course = Course(CRAFT, CRAFT, CONFIG, None, changes)
    lesson = course.lesson(folds_of(LOGS, None, CONFIG)[0], "staged")
    steps = course.taught("", "hybrid", "staged", lesson, 1).trained
    assert [step.epochs for step in steps] == [step.epochs for step in RECIPES["staged"].source]
    assert {step.kept for step in steps} == {("cable_pull",) if changes else ()}


def test_adaptation_leaves_the_estimator_s_gain_as_the_source_has_it():
    fields = fresh("hybrid", replace(CRAFT, learn=("drag", "velocity_gain", "velocity_lag")), RECIPES["staged"], 4, 1)
    one = lane(fields, 0)
    for step in RECIPES["staged"].adaptation:
        rates = rates_by_group(one, rates_of(step, "hybrid", one)).physics.deviations
        assert {name for name, rate in rates.items() if rate == 0} == {"velocity_gain"}
