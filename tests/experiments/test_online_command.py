"""Flights in which the vehicle changes in the air: the truth, the claims, and the command."""

from itertools import product

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.online.agents import L1, NAMES, fixed_model, nominal, true_theta, with_theta
from experiments.online.config import OnlineConfig
from experiments.online.hover import FAULTS, PATH, RIGHT, Hovered, adaptation_of, hover
from experiments.online.results import TAGS, GoalEvidence, claims, tables
from experiments.online.worlds import Equations, body_of, plant_of, truth_of
from experiments.reporting.claims import evaluate
from experiments.reporting.results import Results
from experiments.worlds.iris import domain_of
from experiments.worlds.rotorpy import advance
from hybrid_jax.control import lagged_speeds
from hybrid_jax.sim.forces import ground_effect, wind
from hybrid_jax.vehicle import BODY_RATES, IRIS

STATES = np.random.default_rng(0).normal(size=(3, 13)).astype(np.float32)
STATES[:, 3:7] /= np.linalg.norm(STATES[:, 3:7], axis=1, keepdims=True)
SPEEDS = (IRIS.hover_speed + 80 * np.random.default_rng(1).normal(size=(3, 4))).astype(np.float32)


CHANGES = OnlineConfig().changes


@pytest.mark.parametrize("change", CHANGES)
def test_the_oracle_is_the_simulator_without_ground_effect(change):
    quadrotor = domain_of(change).quadrotor()
    known = tuple(force for force in quadrotor.forces if force not in (ground_effect, wind))
    truth, field = type(quadrotor)(quadrotor.parameters, known), with_theta("iris", true_theta("iris", change))
    for x, u in zip(STATES, SPEEDS, strict=True):
        expected = eqx.filter_jit(truth.derivative)(jnp.asarray(x), jnp.asarray(u), 0.0)
        np.testing.assert_allclose(field(x, u), expected, rtol=2e-4, atol=2e-4)


@pytest.mark.parametrize("world", ["hummingbird", "crazyflie"])
@pytest.mark.parametrize("change", CHANGES)
def test_the_true_parameters_are_rotorpys_equations_in_hover(world, change):
    """To first order in the velocity; an unchanged vehicle in the body rates as well."""
    truth, field = truth_of(world, change, 0.0), with_theta(world, true_theta(world, change))
    x, u = jnp.zeros(13).at[3].set(1.0), jnp.full(4, body_of(world, change).vehicle.hover_speed)
    calm = truth._replace(wind=np.zeros(3, np.float32))
    for part in (lambda f: f(x, u), lambda f: jax.jacfwd(f)(x, u)[7:10, 7:10]):
        np.testing.assert_allclose(part(field), part(Equations(calm)), rtol=1e-4, atol=2e-4)
    ours, theirs = (jax.jacfwd(f)(x, u)[10:, 7:] for f in (field, Equations(calm)))
    assert change != "nothing" or np.allclose(ours, theirs, atol=2e-3)


def test_rotorpys_plant_recovers_the_command_from_the_mean_speed():
    truth, lag, (before, command) = truth_of("crazyflie", "nothing", 0.0), 0.072, np.float32(1e3) + SPEEDS[:2]
    moved = plant_of(truth, before, lag)(STATES[0], lagged_speeds(before, command, lag, 0.01)[0], 0.0)
    np.testing.assert_allclose(moved, advance(truth, STATES[0], before, command, 0.0)[0][0], atol=1e-5)


def test_an_oracle_of_the_wind_expects_its_force():
    agent = fixed_model(nominal("iris"), 0.01, clock=1.3, share=1.0)
    state = agent.update(agent.begin(jnp.asarray(STATES[0])), jnp.asarray(STATES[0]), jnp.asarray(SPEEDS[0]))
    extra = agent.model(state)(STATES[0], SPEEDS[0]) - nominal("iris")(STATES[0], SPEEDS[0])
    force = (-4 + np.sin(2 / 3 * np.pi * 1.31)) / IRIS.mass
    np.testing.assert_allclose(extra[7:10], [0, force, 0], atol=1e-4)


@pytest.mark.parametrize("world", ["iris", "hummingbird"])
def test_what_l1_commands_is_what_its_model_lacks(world):
    agent = L1(nominal(world), 5.0, np.float32(5.0), 0.01)
    missing = jnp.array([-0.5, 1.0, -2.0, 0.3])  # thrust [m/s²] and ω̇ that the model lacks
    u, x = jnp.asarray(SPEEDS[0]), jnp.zeros(13).at[3].set(1.0)
    commanded = agent.command((None, None, missing), None, u)
    gained = agent.field(x, commanded)[9:] - agent.field(x, u)[9:]
    np.testing.assert_allclose(gained, -missing, atol=2e-3)
    np.testing.assert_allclose(agent.effective((None, None, missing), commanded), u, rtol=1e-5)


def rows(online=1.1, unchanged=1.0, inside=0.95, crash=False, world="iris"):
    """Three seeds in which the oracle errs by 1 cm and the unadapted model by 3; online adaptation as given."""
    found = []
    for change, agent, seed in product(("external_force", "nothing"), ("unadapted", "online", "oracle"), range(3)):
        own = {"unadapted": 1.0 if change == "nothing" else 3.0, "oracle": 1.0}.get(agent, online)
        own = unchanged if (agent, change) == ("online", "nothing") else own
        row = {"world": world, "change": change, "reference": "hover", "agent": agent, "seed": seed}
        row |= {"settled": own * (1 + 0.001 * seed) / 100, "first_second": 0.05, "largest": 0.1}
        row |= {"crashed": crash and agent == "online", "alarms": 1, "first_alarm": 0.06}
        found.append(row | ({"inside": dict.fromkeys(NAMES, inside)} if agent == "online" else {}))
    return Results(found, TAGS)


def judged(rows, step_ms=0.1, seconds=1.0):
    evidence = GoalEvidence(rows, step_ms, seconds, processor_seconds=1.0)
    return evaluate(claims(["external_force", "nothing"]), evidence)


@pytest.mark.parametrize(
    ("change", "times", "fails"),
    [
        ({}, {}, []), ({"online": 1.3}, {}, ["O1a"]), ({"unchanged": 1.05}, {}, ["O3"]),
        ({"inside": 0.8}, {}, ["O4"]), ({"crash": True}, {}, ["O1a", "O1b", "O2", "O3"]),
        ({}, {"step_ms": 0.3, "seconds": 600.0}, ["O5", "O6"]),
    ],
)  # fmt: skip
def test_each_claim_fails_where_it_should(change, times, fails):
    """Also if it holds in another world, and says in which."""
    both = rows() + rows(**change, world="hummingbird")
    verdicts = judged(both, **times)
    assert [each.id for each in verdicts if not each.holds] == fails
    for each in verdicts[:5]:
        assert "Iris (our simulator) ✓ holds" in each.measured
        assert ("Hummingbird (RotorPy) ✓ holds" in each.measured) == (each.id not in fails)
    assert {each.header[0] for each in tables(both)} >= {"change"}


@pytest.mark.slow
def test_wrong_sensors_and_exchanged_rotors_are_named_and_end_the_adaptation():
    """The Iris on a path of 3 m: wrong signs of its rates, degrees, exchanged rotors from the beginning, and none."""
    keys = jax.random.split(jax.random.key(0), len(FAULTS[0]))
    found = hover(adaptation_of("iris", 1.0), "iris", 1.0, 30, jnp.zeros(len(keys)), keys, FAULTS, PATH)
    np.testing.assert_array_equal(found.exchanged[4:, 29], FAULTS[0][4:] != RIGHT)
    np.testing.assert_array_equal(found.reversed[:3, 29, BODY_RATES], np.eye(3, dtype=bool))
    assert not found.reversed[4:].any()
    assert found.inconsistent[:10, 29].all()
    assert not found.theta[4:10, 29].any()  # the first model
    assert found.ratios(25, 30)[:10].max() < 1.01
    assert not found.exchanged[10].any()
    assert not found.inconsistent[10].any()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("world", "noise", "named"),
    [("iris", 1.0, False), ("hummingbird", 1.0, False), ("iris", 0.1, False), ("iris", 1.0, True)],
)
def test_hover_is_never_worse_than_without_adapting_and_a_wind_is_found(world, noise, named):
    keys, gusts = jax.random.split(jax.random.key(0)), jnp.array([0.0, 1.0])
    found = Hovered(*map(np.asarray, hover(adaptation_of(world, noise, named), world, noise, 300, gusts, keys)))
    assert found.ratios(10, 300).max() < 1.05
    # The calm flight after its start, which moves; gusts move parameters that they hide.
    assert np.abs(found.theta[0, 10:300, :3]).max() < 0.05
    inside = np.abs(found.theta) < 1.96 * found.deviation
    assert inside[:, 10:300, :3].mean(axis=1).min() > 0.9  # of the time
    assert found.found(300).max() <= 1  # s, in calm air and in gusts
