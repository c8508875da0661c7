"""Worlds of RotorPy and of reaction-diffusion equations; the logs of a flight; and what is said of rows."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hybrid_jax as hj
from experiments.changes.measures import EXPECTED, parameters_of
from experiments.changes.verdicts import CLAIMS
from experiments.reaction_diffusion.models import pieces
from experiments.reaction_diffusion.systems import COARSE, DT, FINE, fitzhugh_nagumo, plane, reacting, trajectories
from experiments.reporting.claims import evaluate
from experiments.reporting.results import Results
from experiments.worlds.flights import WORLDS
from experiments.worlds.rotorpy import CRAZYFLIE, HUMMINGBIRD, decide, derivative
from experiments.worlds.world import BURST, Reference, logged
from hybrid_jax.adaptation.results import Parameter
from hybrid_jax.vehicle import IRIS


@pytest.mark.parametrize(("module", "constants"), [("hummingbird", HUMMINGBIRD), ("crazyflie", CRAZYFLIE)])
def test_the_derivative_and_the_controller_are_those_of_rotorpy(module, constants):
    flapping = 1e-5  # which no vehicle of RotorPy has
    params = pytest.importorskip(f"rotorpy.vehicles.{module}_params").quad_params | {"k_flap": flapping}
    from rotorpy.controllers.quadrotor_control import SE3Control
    from rotorpy.vehicles.multirotor import Multirotor

    rng, theirs, pilot = np.random.default_rng(0), Multirotor(params), SE3Control(params)
    for _ in range(10):
        x, v, rates, wind, place, velocity, acceleration = rng.normal(size=(7, 3))
        w, i, j, k = q = (lambda q: q / np.linalg.norm(q))(rng.normal(size=4))
        speeds, command = params["rotor_speed_max"] * rng.uniform(size=(2, 4))
        heading, turn = rng.normal(size=2)
        state = {"x": x, "v": v, "q": np.array([i, j, k, w]), "w": rates, "wind": wind, "rotor_speeds": speeds}
        wanted = {"x": place, "x_dot": velocity, "x_ddot": acceleration, "yaw": heading, "yaw_dot": turn}
        packed = theirs._s_dot_fn(0.0, theirs._pack_state(state), command)
        asked = pilot.update(0.0, state, wanted)["cmd_motor_speeds"]
        with jax.enable_x64(True):
            ours, now = jnp.concatenate([x, q, v, rates]), Reference(*map(jnp.asarray, wanted.values()))
            found, lagging = derivative(constants._replace(flapping=flapping), ours, speeds, command, wind)
            own = decide(constants, ours, now)
        np.testing.assert_allclose(found, packed[[0, 1, 2, 9, 6, 7, 8, 3, 4, 5, 10, 11, 12]], rtol=1e-10, atol=1e-10)
        np.testing.assert_allclose(lagging, packed[16:], rtol=1e-10)
        np.testing.assert_allclose(own, asked, rtol=1e-10)


def test_a_log_has_sampled_or_averaged_speeds_and_wild_samples():
    """A motor lags by 5 ms, so that the mean over 10 ms is nearer to the next sample than to the last."""
    flown = WORLDS["hummingbird"].fly("nothing", "moving", 2, 5.0, jax.random.key(0))
    last, following = flown.sampled[:, :-1], flown.sampled[:, 1:]
    assert np.abs(flown.averaged[:, :-1] - following).mean() < np.abs(flown.averaged[:, :-1] - last).mean()
    options = {"noise": 0.0}, {"averaged": False}, {"burst": True}
    clean, sampled, wild = (logged(flown, jax.random.key(1), 10, **each) for each in options)
    np.testing.assert_array_equal(clean.x0[0], flown.states[0, 0].astype(np.float32))
    np.testing.assert_array_equal(sampled.u[0], flown.sampled[0, :10].astype(np.float32))
    np.testing.assert_array_equal(wild.x0[1], wild.x[0, -1])  # windows share the sample between them
    away = np.abs(wild.x - clean.x)[..., 0].reshape(2, -1)
    assert away[:, BURST].mean() > 20 * away[:, : BURST.start - 1].mean()


def rows(inside=19.0, expected=0.8, sources=40, own=0.04, kept=20, **ratios):
    """Some cases in one world: an error over the source's, and intervals that hold in so many of twenty draws."""
    tags = {"world": "iris", "flight": "moving", "method": "auto", "chosen": "theta", "made_for": True}
    first = {"change": "nothing", "draw": 0, "seed": 0, "method": "source"}
    found = [tags | first | {f"{name}_error": -own for name in ("Ix", "Iy", "k")}]
    for change, ratio in ratios.items():
        for draw, seed in np.ndindex(20, sources):
            theta = {f"{name}_inside": draw + seed / sources < inside for name in ("Ix", "Iy", "k")}
            theta |= {f"{name}_kept_inside": draw < kept for name in ("Ix", "Iy", "k")}
            row = {"change": change, "draw": draw, "seed": seed, "ratio": ratio if draw else 2 * ratio}
            found.append(tags | theta | row | dict.fromkeys(EXPECTED, expected + 0.1 * (-1) ** seed))
    return Results(found, ("world", "change", "flight", "draw", "seed", "method"))


@pytest.mark.parametrize(
    ("change", "fails", "undecided"),
    [
        ({}, [], []),
        ({"drag": 0.7}, ["W1"], []),  # 1.4 in one adaptation
        ({"drag": 1.01, "nothing": 0.1}, ["W1"], []),
        ({"inside": 19.97}, ["W2"], []),  # all but those of one adaptation
        ({"inside": 17}, ["W2"], []),
        ({"inside": 20}, [], ["W2"]),  # are those of a source alike?
        ({"sources": 1}, [], ["W2", "W3", "W5"]),
        ({"expected": 0.5}, ["W3"], []),
        ({"expected": 0.95}, ["W3"], []),
        ({"expected": 0.9}, [], ["W3"]),
        ({"own": 0.06}, ["W4"], []),
        ({"kept": 15}, ["W5"], []),
    ],
)
def test_each_claim_fails_where_it_should(change, fails, undecided):
    found = {each.id: each.holds for each in evaluate(CLAIMS, rows(**{"nothing": 0.5} | change))}
    for holds, expected in ((False, fails), (None, undecided)):
        assert [id for id, one in found.items() if one is holds] == expected


def test_a_parameter_is_judged_where_it_is_the_vehicles():
    """A load changes the mass, which the model keeps; a weak rotor has no k of its own."""
    found = {"Ix": Parameter(0.03, 0.028, 0.032), "k": Parameter(8.5e-6, 0.0, np.inf)}
    row = parameters_of(WORLDS["iris"], "nothing", found)
    assert row["Ix_inside"] is True
    assert row["Ix_half_width"] == pytest.approx(0.002 / IRIS.inertia[0])
    assert row["k_inside"] is None  # infinite: the windows tell nothing
    assert row["Iy_error"] is None  # not fitted
    assert parameters_of(WORLDS["iris"], "weak_rotor", found)["k_error"] is None
    assert set(parameters_of(WORLDS["hummingbird"], "off_centre_load", found).values()) == {None, False}


def smooth(points):
    """A smooth start on [−1, 1]², which every grid resolves."""
    place = np.arange(points) / points * 2 * np.pi
    wave = np.sin(place)[:, None] * np.cos(place)
    return np.stack([0.5 + 0.3 * wave, 0.2 - 0.3 * wave.T]).reshape(1, -1).astype(np.float32)


def test_the_generator_converges_with_the_grid_and_the_step():
    ends = {}
    for points in (16, 32, 64):
        field = fitzhugh_nagumo(plane(points), a=0.02, b=0.05)
        end = trajectories(field, smooth(points), DT, 5, hj.RK4(substeps=50)).x[0, -1]
        ends[points] = end.reshape(2, points, points)[:, :: points // 16, :: points // 16]
    coarse, fine = (np.abs(ends[n] - ends[2 * n]).max() for n in (16, 32))
    assert 3 < coarse / fine < 5  # second order
    field, start = fitzhugh_nagumo(plane(32)), np.random.default_rng(0).random((1, 2048)).astype(np.float32)
    exact, own, models = (trajectories(field, start, DT, 3, s).x for s in (hj.RK4(substeps=40), FINE, COARSE))
    assert np.abs(own - exact).max() < 1e-6
    assert np.mean(np.square(models - exact)) < 1e-8


def test_the_derivative_is_the_equation():
    grid = plane(8)
    x = np.random.default_rng(0).random(grid.size).astype(np.float32)
    u, v = x.reshape(2, 8, 8)
    around = [sum(np.roll(w, s, axis) for axis in (0, 1) for s in (1, -1)) - 4 * w for w in (u, v)]
    bend = [part / 0.25**2 for part in around]
    expected = [1e-3 * bend[0] + u - u**3 - v - 5e-3 - 0.5 * u * v, 5e-3 * bend[1] + u - v]
    found = fitzhugh_nagumo(grid, coupling=-0.5)(jnp.asarray(x), jnp.zeros(0))
    np.testing.assert_allclose(found, np.ravel(expected), atol=1e-5)


def test_training_and_test_data_are_disjoint_and_pieces_touch():
    field = fitzhugh_nagumo(plane(8))
    one, other = (reacting(field, 2, (seed, 0)) for seed in (10, 11))
    assert not np.array_equal(one.x0, other.x0)
    windows = pieces(one, 3, 3)
    assert len(windows) == 16
    np.testing.assert_array_equal(windows.x[0, -1], windows.x0[1])  # in the order of time, one trajectory after another
    np.testing.assert_array_equal(windows.x0[8], one.x0[1])
    noisy = reacting(field, 2, (10, 0), noise=0.01)
    assert np.std(noisy.x - one.x) == pytest.approx(0.01, rel=0.1)
