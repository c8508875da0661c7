"""Closed-loop flight: the simulation of scenarios, and the experiment from its command line in the smallest preset."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from choices import slow
from rich.console import Console

import hybrid_jax as hj
from experiments.closed_loop.flights import Scenario, fly_all
from experiments.closed_loop.models import as_stack, fused, true_field
from experiments.closed_loop.results import Agent
from experiments.flying.scenario import PATHS
from experiments.runner.stages import Stages
from hybrid_jax.control import Controller, Hardware, fly, performance, sample
from hybrid_jax.networks.mlp import InputScaling
from hybrid_jax.networks.views import multirotor_network
from hybrid_jax.sim.domain import EXTERNAL_FORCE, PARAMETER_SHIFT, SOURCE

CONTROLLER = Controller(hj.IRIS)
SCALING = InputScaling(hj.IRIS.hover_speed, hj.IRIS.hover_speed / 10)
BODY = hj.RigidBody({"Ix": jnp.asarray(0.1), "Iy": jnp.asarray(-0.2), "k": jnp.asarray(0.05)}, hj.IRIS)
SECONDS = 0.6


@pytest.mark.parametrize("domain", [EXTERNAL_FORCE, *slow(SOURCE, PARAMETER_SHIFT)], ids=lambda domain: domain.name)
def test_true_field_equals_the_simulator_in_the_mean_wind(domain):
    rng = np.random.default_rng(0)
    x = rng.normal(size=(5, 13)).astype(np.float32)
    x[:, 2] = rng.uniform(0.2, 1.0, 5)
    x[:, 3:7] /= np.linalg.norm(x[:, 3:7], axis=1, keepdims=True)
    u = rng.uniform(500, 800, (5, 4)).astype(np.float32)
    truth = domain.quadrotor()
    # At time 0 the wind's sine is 0.
    expected = jax.jit(jax.vmap(lambda x, u: truth.derivative(x, u, jnp.zeros(()))))(x, u)
    found = jax.jit(jax.vmap(true_field(domain, hj.IRIS)))(x, u)
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-5 * float(jnp.abs(expected).max()))


@pytest.fixture(scope="module")
def models():
    """Models of three structures by agent, and the hybrid among them."""
    network = multirotor_network(hj.IRIS, jax.random.key(1), hidden=8, scaling=SCALING)
    hybrid = hj.Hybrid(BODY, eqx.tree_at(lambda n: n.weight_out, network, 0.01 * network.weight_out))
    stacked = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), hybrid)
    nominal, true = as_stack(hj.rigid_body(hj.IRIS)), as_stack(true_field(PARAMETER_SHIFT, hj.IRIS))
    return {Agent("nominal"): nominal, Agent("hybrid"): fused(stacked), Agent("oracle"): true}, hybrid


@pytest.fixture(scope="module")
def flights(models, tmp_path_factory):
    """A figure-8 with the other inertia, flown once and then found in the cache."""
    stages = Stages(tmp_path_factory.mktemp("closed_loop"), Console(quiet=True))
    scenarios = [Scenario(PARAMETER_SHIFT, "figure_eight", 0.0, models[0], 10.0)]
    runs = [fly_all(scenarios, CONTROLLER, SECONDS, stages)[0] for _ in range(2)]
    assert stages.reused == ["flights parameter_shift figure_eight"]
    for name, array in runs[0].arrays.items():
        np.testing.assert_array_equal(runs[1].arrays[name], array)
    return runs[0]


@pytest.mark.slow
def test_a_flight_of_a_scenario_equals_the_flight_alone(models, flights):
    _, hybrid = models
    reference = sample(PATHS["figure_eight"], CONTROLLER, SECONDS)
    truth = PARAMETER_SHIFT.quadrotor()

    @jax.jit
    def alone():
        flight = fly(lambda x, u, t: truth.step(x, u, t, 0.01), hybrid, reference, reference[0], CONTROLLER)
        return flight.x, performance(flight, reference, CONTROLLER)

    x, found = alone()
    for seed in range(2):
        np.testing.assert_allclose(flights.states(Agent("hybrid"), seed), x[::5], rtol=0, atol=2e-3)
        row = flights.rows()[1 + seed]
        assert (row["model"], row["seed"]) == ("hybrid", seed)
        assert row["position_rmse"] == pytest.approx(float(found.position_rmse), abs=2e-4)


@pytest.mark.slow
def test_true_model_tracks_better_than_the_nominal_one_and_predicts_its_cost(flights):
    rows = {row["model"]: row for row in flights.rows()}
    assert rows["oracle"]["position_rmse"] < rows["nominal"]["position_rmse"]
    assert abs(rows["oracle"]["excess"]) < 0.02  # plans have steps of 0.05 s, the simulation of 0.01 s


@pytest.mark.slow
def test_sensors_and_rotors_act_with_a_noise_for_each_seed(models, flights, tmp_path):
    noisy = Hardware(latency=0.01, rotor_lag=0.03, noise=(0.001, 0.002, 0.02, 0.02))
    own = {Agent("hybrid"): models[0][Agent("hybrid")]}  # two seeds of the same model
    options = [Scenario(PARAMETER_SHIFT, "figure_eight", 0.0, own, 10.0)], Controller(hj.IRIS, rotor_lag=0.03), SECONDS
    (found,) = fly_all(*options, Stages(tmp_path, Console(quiet=True)), noisy)
    exact, first, second = (each.states(Agent("hybrid"), i) for each, i in ((flights, 0), (found, 0), (found, 1)))
    assert np.abs(first - exact)[-1].max() > 1e-3
    assert np.abs(first - second)[-1].max() > 1e-3
