"""Closed-loop flight: what the lanes fly, and the experiment from its command line in the smallest preset."""

import csv
import io
import json
import os
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from rich.console import Console
from smoke import command, experiments, refused, smallest, unbegun

import hybrid_jax as hj
from experiments.closed_loop.common_field import common, true_field
from experiments.closed_loop.lanes import PATHS, Airspace, Block, Flights
from experiments.closed_loop.models import in_common, single, with_statistics_of
from experiments.closed_loop.rows import FlightRow, Flyer
from experiments.closed_loop.timing import confined
from experiments.paper.config import SMOKE
from hybrid_jax.control import Controller, fly, performance, sample
from hybrid_jax.dynamics.base import linearize
from hybrid_jax.dynamics.disturbance import ConstantDisturbance
from hybrid_jax.dynamics.rigid_body import ForcedBody
from hybrid_jax.networks.mlp import InputScaling
from hybrid_jax.networks.normalisation import BatchNorm
from hybrid_jax.networks.views import restricted
from hybrid_jax.runtime import cores
from hybrid_jax.sim.domain import EXTERNAL_FORCE, PARAMETER_SHIFT, SOURCE

CONTROLLER = Controller(hj.IRIS)
SCALING = InputScaling(hj.IRIS.hover_speed, hj.IRIS.hover_speed / 10)
BODY = hj.RigidBody({"Ix": jnp.asarray(0.1), "Iy": jnp.asarray(-0.2), "k": jnp.asarray(0.05)}, hj.IRIS)
FORCED = ForcedBody(BODY.log_ratios, hj.IRIS)
SECONDS = 0.6


def network(inputs="all", outputs="all", norm="batch", linear=False):
    """A network whose statistics, and linear path, are not those that it began with."""
    known = {"hidden": 8, "scaling": SCALING, "vehicle": hj.IRIS}
    made = restricted(jax.random.key(1), inputs=inputs, outputs=outputs, norm=norm, linear=linear, **known)
    if linear:
        made = jax.tree.map(lambda leaf: leaf + jnp.sin(jnp.arange(leaf.size)).reshape(leaf.shape), made)

    def seen(node):
        if not isinstance(node, BatchNorm):
            return node
        return eqx.tree_at(lambda norm: (norm.running.mean, norm.shift), node, (jnp.arange(8.0), jnp.ones(8)))

    return jax.tree.map(seen, made, is_leaf=lambda node: isinstance(node, BatchNorm))


MODELS = {
    "physics": BODY,
    "physics twice": hj.Hybrid(BODY, BODY),
    "network": network(),
    "hybrid": hj.Hybrid(BODY, network()),
    "without a norm": hj.Hybrid(BODY, network(norm="none")),
    "with layer norm": hj.Hybrid(BODY, network(norm="layer")),
    "from the body": hj.Hybrid(BODY, network("body", "motion")),
    "no place": hj.Hybrid(BODY, network("no_xy", "all")),
    "safe": hj.Hybrid(BODY, network("no_xy_yaw", "accelerations")),
    "near the ground": hj.Hybrid(BODY, network("near_ground", "accelerations", "none")),
    "linear": hj.Hybrid(FORCED, network("near_ground", "accelerations", "none", linear=True)),
    "rotors": hj.Hybrid(FORCED, network("near_ground", "rotors", "none", linear=True)),
    "linear, with batch norm": hj.Hybrid(BODY, network("no_xy_yaw", "accelerations", "batch", linear=True)),
    "forced and disturbed": hj.Hybrid(
        hj.Hybrid(FORCED, ConstantDisturbance(jnp.arange(6.0))), network("near_ground", "accelerations", linear=True)
    ),
    "disturbed": hj.Hybrid(
        hj.Hybrid(BODY, ConstantDisturbance(jnp.arange(6.0))), network("no_xy_yaw", "accelerations")
    ),
}


def samples(count=5):
    rng = np.random.default_rng(0)
    x = rng.normal(size=(count, 13))
    x[:, 2] = rng.uniform(0.2, 1.0, count)
    x[:, 3:7] /= np.linalg.norm(x[:, 3:7], axis=1, keepdims=True)
    return jnp.asarray(x, jnp.float32), jnp.asarray(rng.uniform(500, 800, (count, 4)), jnp.float32)


@pytest.mark.parametrize("name", MODELS)
def test_the_common_form_is_the_model_itself(name):
    x, u = samples()
    field = common(MODELS[name], hj.IRIS, 8, SCALING)
    expected = jax.vmap(MODELS[name])(x, u)
    # Single precision, sums of some thirty terms of the size of the largest.
    np.testing.assert_allclose(jax.vmap(field)(x, u), expected, rtol=1e-4, atol=1e-5 * float(jnp.abs(expected).max()))


@pytest.mark.parametrize("name", MODELS)
def test_the_common_form_knows_its_own_derivative(name):
    """In each direction what autodiff says, whatever short cut it takes."""
    field = common(MODELS[name], hj.IRIS, 8, SCALING)
    dx, du = jnp.eye(17)[:13], jnp.eye(17)[13:]
    for x, u in zip(*samples(), strict=True):
        value, slope = linearize(field, x, u, dx, du)
        expected = jnp.concatenate(jax.jacfwd(field, argnums=(0, 1))(x, u), axis=1)
        np.testing.assert_allclose(value, field(x, u), rtol=1e-5, atol=1e-5 * float(jnp.abs(value).max()))
        np.testing.assert_allclose(slope, expected, rtol=1e-4, atol=1e-5 * float(jnp.abs(expected).max()))


@pytest.mark.parametrize("domain", [SOURCE, PARAMETER_SHIFT, EXTERNAL_FORCE], ids=lambda domain: domain.name)
def test_the_oracle_is_the_simulator_in_the_mean_wind(domain):
    x, u = samples()
    truth = domain.quadrotor()
    # At time 0 the wind's sine is 0.
    expected = jax.jit(jax.vmap(lambda x, u: truth.derivative(x, u, jnp.zeros(()))))(x, u)
    found = jax.vmap(true_field(domain, hj.IRIS))(x, u)
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-5 * float(jnp.abs(expected).max()))


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="this system binds no process to a core")
def test_calls_are_timed_by_a_process_that_has_one_core(tmp_path):
    with ProcessPoolExecutor(1, get_context("spawn"), confined, (tmp_path,)) as process:
        assert process.submit(cores).result() == 1
    assert cores() == len(os.sched_getaffinity(0))


def test_statistics_are_all_that_is_taken_over():
    field, source = MODELS["safe"], hj.Hybrid(BODY, restricted(jax.random.key(2), hidden=8, inputs="no_xy_yaw"))
    mixed = with_statistics_of(source, field)
    np.testing.assert_array_equal(mixed.residual.field.field.norm.running.mean, np.zeros(8))
    np.testing.assert_array_equal(mixed.residual.field.field.weight_in, field.residual.field.field.weight_in)


@pytest.fixture(scope="module")
def crew():
    """Who flies, in the common form, and the hybrid as it was."""
    hybrid = hj.Hybrid(BODY, eqx.tree_at(lambda n: n.weight_out, network(), 0.01 * network().weight_out))
    stacked = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), hybrid)
    flyers = {
        Flyer("nominal"): in_common(single(hj.rigid_body(hj.IRIS)), hj.IRIS, SMOKE),
        Flyer("hybrid"): in_common(stacked, hj.IRIS, SMOKE),
        Flyer("oracle"): single(true_field(PARAMETER_SHIFT, hj.IRIS)),
    }
    return flyers, hybrid


@pytest.fixture(scope="module")
def flights(crew, tmp_path_factory):
    """A figure-8 under the parameter shift, flown once and found once."""
    folder = tmp_path_factory.mktemp("closed_loop")
    said = io.StringIO()
    block = Block(PARAMETER_SHIFT, "figure_eight", 0.0, crew[0])
    space = Airspace(CONTROLLER, SECONDS, 10.0, [block], folder, Console(file=said))
    flown, found = space.fly(block), space.fly(block)
    assert "as found in the cache" in said.getvalue().splitlines()[1]
    for name, array in flown.arrays.items():
        np.testing.assert_array_equal(found.arrays[name], array)
    return flown


def test_rows_are_told_in_the_order_of_the_crew(crew):
    small = crew[0][Flyer("hybrid")]
    block = Block(PARAMETER_SHIFT, "hover", 0.0, {Flyer("hybrid"): small, Flyer("hybrid", 20): small})
    names = ("position_rmse", "yaw_rmse", "largest_error", "saturation", "excess", "promised", "realised", "crashed")
    found = Flights(block, {name: np.arange(4.0) for name in names}, 1.0, 1.0, 1).rows()
    assert [row.flyer for row in found] == [flyer for flyer in block.flyers for _ in range(2)]
    assert [row.position_rmse for row in found] == [0, 1, 2, 3]


def test_a_lane_is_the_lone_flight_of_its_model(crew, flights):
    _, hybrid = crew
    reference = sample(PATHS["figure_eight"], CONTROLLER, SECONDS)
    truth = PARAMETER_SHIFT.quadrotor()

    @jax.jit
    def alone():
        flight = fly(lambda x, u, t: truth.step(x, u, t, 0.01), hybrid, reference, reference[0], CONTROLLER)
        return flight.x, performance(flight, reference, CONTROLLER)

    x, found = alone()
    for seed in range(2):
        np.testing.assert_allclose(flights.states(Flyer("hybrid"), seed), x[::5], rtol=0, atol=2e-3)
        row = flights.rows()[1 + seed]
        assert (row.model, row.seed) == ("hybrid", seed)
        assert row.position_rmse == pytest.approx(float(found.position_rmse), abs=2e-4)


def test_the_true_vehicle_flies_better_than_the_nominal_one_and_keeps_its_promise(flights):
    rows = {row.model: row for row in flights.rows()}
    assert rows["oracle"].error < rows["nominal"].error
    # Plans are made in steps of 0.05 s and flown in steps of 0.01 s.
    assert abs(rows["oracle"].excess) < 0.02
    assert not rows["oracle"].crashed


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Left by one run of the command."""
    folder = tmp_path_factory.mktemp("closed_loop_command")
    (run,) = experiments("closed_loop", "closed_loop", folder=folder)
    assert run.returncode == 0, run.stderr
    assert "What was to be reached" in run.stdout
    return folder


def test_the_report_keeps_its_contract(folder):
    out = folder / "out" / "closed_loop"
    report = json.loads((out / "report.json").read_text())
    assert {"versions", "hardware", "seconds"} <= set(report["environment"])
    rows = [FlightRow(**row) for row in report["rows"]]
    # Nominal, oracle; 20 of physics, no-physics, nine numbers; source and 20 of two hybrids; and six with observers.
    # On the unchanged vehicle nominal, oracle, two sources, and three with observers.
    assert len(rows) == 2 * (2 + 1) * 15 + 2 * 7
    # An observer on what was not adapted flies wherever anything flies.
    everywhere = [(row["domain"], row["reference"], row["distance"]) for row in report["rows"] + report["ablation"]]
    observed = [row for row in report["rows"] + report["ablation"] if row["observer"] and not row["n_train"]]
    assert {(row["domain"], row["reference"], row["distance"]) for row in observed} == set(everywhere)
    assert any(row["variant"] for row in observed)
    assert {row.distance for row in rows} == {0.0, 60.0}
    assert {row.n_train for row in rows if row.domain == "source"} == {0}
    assert {row["variant"] for row in report["ablation"]} > {"safe, batch statistics of the source"}
    assert {claim["id"] for claim in report["claims"] + report["not_judged"]} >= {"R1a", "R6b", "R7", "R8"}
    assert set(report["speed"]) == {"nominal physics", "hybrid, N = 20", "safe hybrid, N = 20"}
    for name in report["figures"]:
        assert (out / name).read_bytes().startswith(b"\x89PNG")
    assert len(list(csv.DictReader((out / "rows.csv").open()))) == len(rows) + len(report["ablation"])
    assert "no p_x, p_y, yaw" in (out / "report.md").read_text()


def test_a_second_run_trains_and_flies_nothing(folder):
    less = ("--references", "hover", "--away-references", "hover", "--ablation", "--calls", "1")
    again = command("closed_loop", *less, folder=folder, out=folder / "again")
    assert again.returncode == 0, again.stderr
    # Four models: pre-training, of the safe one in three stages, and two adaptations each; hover in three domains, and
    # away in two.
    assert again.stderr.count("as found in the cache") == 4 * 3 + 2 + 3 + 2, again.stderr
    assert "runs active" not in again.stderr
    first, second = (json.loads((folder / out / "closed_loop" / "report.json").read_text()) for out in ("out", "again"))
    assert second["rows"] == [row for row in first["rows"] if row["reference"] == "hover"]


@pytest.mark.parametrize(
    ("options", "named"),
    [
        (("--references", "hover", "hover"), "--references must be at least one, each different"),
        (("--references", "hover", "--away-references", "low_pass"), "--away-references must be among --references"),
        (("--seconds", "0.2"), "--seconds must be at least 1"),
        (("--residual-outputs", "accelerations"), "no_physics must write all derivatives"),
    ],
    ids=["twice", "not at home", "short", "no physics without velocities"],
)
def test_options_that_do_not_fit_are_refused_before_anything_is_trained(options, named, tmp_path):
    assert named in refused(unbegun("closed_loop", *smallest(*options, folder=tmp_path)), "closed_loop")
    assert not list(tmp_path.iterdir())
