"""Closed-loop flight: the simulation of scenarios; tables and hypotheses on rows with known numbers."""

from dataclasses import asdict

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from choices import slow
from rich.console import Console
from systems import HOVER, flying

import hybrid_jax as hj
from experiments.closed_loop.claims import FlightEvidence, Speed, claims
from experiments.closed_loop.flights import Scenario, fly_all
from experiments.closed_loop.models import as_stack, fused, true_field
from experiments.closed_loop.results import TAGS, Agent
from experiments.flying.scenario import PATHS, REFERENCES
from experiments.reporting.claims import evaluate
from experiments.reporting.results import Results
from experiments.runner.stages import Stages
from hybrid_jax.control import Controller, Hardware, fly, performance, sample
from hybrid_jax.networks import multirotor_network
from hybrid_jax.sim import EXTERNAL_FORCE, PARAMETER_SHIFT, SOURCE

CONTROLLER = Controller(hj.IRIS)
BODY = hj.RigidBody({"Ix": jnp.asarray(0.1), "Iy": jnp.asarray(-0.2), "k": jnp.asarray(0.05)}, hj.IRIS)
SECONDS = 0.6


@pytest.mark.parametrize("domain", [EXTERNAL_FORCE, *slow(SOURCE, PARAMETER_SHIFT)], ids=lambda domain: domain.name)
def test_true_field_equals_the_simulator_in_the_mean_wind(domain):
    x, u = (part.astype(np.float32) for part in flying(5))
    x[:, 2] = np.linspace(0.2, 1.0, 5)
    truth = domain.quadrotor()
    # At time 0 the wind's sine is 0.
    expected = jax.jit(jax.vmap(lambda x, u: truth.derivative(x, u, jnp.zeros(()))))(x, u)
    found = jax.jit(jax.vmap(true_field(domain, hj.IRIS)))(x, u)
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-5 * float(jnp.abs(expected).max()))


@pytest.fixture(scope="module")
def models():
    """Models of three structures by agent, and the hybrid among them."""
    network = multirotor_network(hj.IRIS, jax.random.key(1), hidden=8, scaling=HOVER)
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
def test_sensors_and_rotors_act_with_a_noise_for_each_seed(models, flights, tmp_path):
    noisy = Hardware(latency=0.01, rotor_lag=0.03, noise=(0.001, 0.002, 0.02, 0.02))
    own = {Agent("hybrid"): models[0][Agent("hybrid")]}  # two seeds of the same model
    options = [Scenario(PARAMETER_SHIFT, "figure_eight", 0.0, own, 10.0)], Controller(hj.IRIS, rotor_lag=0.03), SECONDS
    (found,) = fly_all(*options, Stages(tmp_path, Console(quiet=True)), noisy)
    exact, first, second = (each.states(Agent("hybrid"), i) for each, i in ((flights, 0), (found, 0), (found, 1)))
    assert np.abs(first - exact)[-1].max() > 1e-3
    assert np.abs(first - second)[-1].max() > 1e-3


FEW, SEEDS = 100, 3
AGENTS = {  # position RMSE [m] with the other inertia and in the wind
    Agent("nominal"): (0.1, 0.4),
    Agent("oracle"): (0.01, 0.05),
    Agent("hybrid"): (0.02, 0.4),
    Agent("hybrid", FEW): (0.015, 0.07),
    Agent("hybrid", observer=True): (0.016, 0.08),
    Agent("hybrid", FEW, observer=True): (0.012, 0.06),
    Agent("invariant"): (0.02, 0.4),
    Agent("invariant", observer=True): (0.016, 0.08),
    Agent("invariant", FEW): (0.011, 0.055),
    Agent("invariant", FEW, observer=True): (0.0105, 0.052),
    Agent("least_squares", FEW): (0.0115, 0.0545),
    Agent("least_squares", FEW, observer=True): (0.0106, 0.0515),
}
SPEED = Speed(1.2, 1.4, 3600.0, 100.0, 190.0, 2)


def make_rows(reference="hover", distance=0.0):
    """The seeds of trained models are 1 % apart."""
    return [
        {
            "domain": domain, **asdict(agent), "reference": reference, "distance": distance, "seed": seed,
            "position_rmse": mean * (1 + 0.01 * seed), "yaw_rmse": 0.01, "largest_error": 2 * mean, "crashed": False,
            "saturation": 0.0, "promised": 1.0, "realised": 1.05, "excess": 0.05,
        }
        for agent, means in AGENTS.items()
        for domain, mean in zip(("parameter_shift", "external_force"), means, strict=True)
        for seed in range(1 if agent.model in ("nominal", "oracle") else SEEDS)
    ]  # fmt: skip


ROWS = Results([row for reference in REFERENCES for row in make_rows(reference)] + make_rows(distance=60.0), TAGS)
WORSE_AWAY = Results([{**row, "position_rmse": row["position_rmse"] * (1.2 if row["distance"] else 1)} for row in ROWS])


def changed(rows, agent, domain="external_force", reference="hover", **values):
    place = {"domain": domain, "reference": reference, **asdict(agent)}
    return Results([{**row, **values} if place.items() <= row.items() else row for row in rows], TAGS)


def verdicts(rows, speed=SPEED):
    return {verdict.id: verdict for verdict in evaluate(claims(FEW), FlightEvidence(rows, speed))}


def holds(*evidence):
    return {name: verdict.holds for name, verdict in verdicts(*evidence).items()}


def test_all_hypotheses_hold_on_these_rows_and_undecided_are_those_of_flights_that_are_missing():
    assert list(holds(ROWS).values()) == [True] * (3 * 7 + 2)
    found = holds(ROWS.where(lambda row: row["reference"] != "low_pass", distance=0.0))
    assert [found[name] for name in ("R1a", "R2a", "R5a", "R6a", "R3a")] == [None] * 4 + [True]
    slow = holds(ROWS, SPEED._replace(call_ms=1.6, seconds=200.0))  # those of speed compare measured times
    assert (slow["R7"], slow["R8"]) == (False, False)


@pytest.mark.parametrize(
    ("goal", "rows"),
    [
        ("R1b", changed(ROWS, Agent("invariant", FEW), crashed=True)),
        ("R2a", changed(ROWS, Agent("hybrid", FEW), position_rmse=0.09)),
        ("R3a", changed(ROWS, Agent("hybrid", FEW), "parameter_shift", "upset", position_rmse=0.021)),
        ("R4a", changed(ROWS, Agent("hybrid", FEW), "parameter_shift", "step", excess=-0.11)),
        ("R5a", changed(ROWS, Agent("hybrid", FEW, observer=True), position_rmse=0.075)),
        ("R9b", changed(ROWS, Agent("invariant", FEW, observer=True), "parameter_shift", "upset", position_rmse=0.017)),
        ("R6b", WORSE_AWAY),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_one_missed_goal_fails_only_its_hypothesis(goal, rows):
    failed = {name for name, outcome in holds(rows).items() if outcome is False}
    # A larger error in the wind also leaves more of the gap; a smaller one at home is a larger ratio away from it.
    also = {"R2a", "R2b", "R2c", "R1a", "R1b", "R1c"} if goal.startswith("R1") else {"R6a", "R6b", "R6c"}
    assert goal in failed
    assert failed <= {goal, *also}


def test_hypotheses_are_undecided_within_the_noise_of_the_seeds():
    """The adapted models differ twentyfold between seeds, with the observer in another order than without."""

    def noisy(row):
        if not row["n_train"] or row["distance"]:
            return row
        factor = (0.2, 1.0, 4.0)[(row["seed"] + row["observer"]) % SEEDS]
        return {**row, "position_rmse": row["position_rmse"] * factor, "excess": 0.05 * (factor - 0.2)}

    found = verdicts(Results([noisy(row) for row in ROWS], TAGS))
    assert {name for name, verdict in found.items() if verdict.holds is not None} == {"R7", "R8"}
    assert not any(verdict.lacks_data for verdict in found.values())
