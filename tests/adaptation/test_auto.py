"""Laws of the choice by left-out windows, of the candidates and of the anchored network."""

from dataclasses import replace

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from pendulum import LENGTH, flown, hybrid, pendulum

import hybrid_jax as hj
from hybrid_jax.adaptation import FineTune, Solution, adapt, auto
from hybrid_jax.adaptation.anchored import fit_anchored, subspace, taken_by_network, with_change
from hybrid_jax.adaptation.evidence import STRONG
from hybrid_jax.adaptation.plausible import CANDIDATES, extended, free_parameters
from hybrid_jax.adaptation.selection import blocks_of
from hybrid_jax.dynamics.disturbance import ConstantDisturbance
from hybrid_jax.estimation.least_squares import ravel_parameters
from hybrid_jax.estimation.normal_equations import NormalEquations
from hybrid_jax.estimation.uncertainty import named_parameters
from hybrid_jax.metrics import rollout_mse
from hybrid_jax.networks.normalisation import ChannelScaling
from hybrid_jax.status import Status


class Parts(hj.AbstractVectorField):
    """A pendulum of which no window tells the parameters apart."""

    parts: jax.Array

    def __call__(self, x, u):
        return pendulum(jnp.sum(self.parts))(x, u)


def test_a_candidate_whose_parameters_no_window_tells_apart_is_fitted_all_the_same():
    result = adapt(Parts(jnp.array([0.3, 0.2, 0.2])), flown(pendulum()))
    assert result.chosen == "theta"
    assert jnp.sum(result.field.parts) == pytest.approx(LENGTH, rel=0.01)
    assert "do not determine parts (3 numbers): other values fit them as well" in result.report()


@pytest.mark.parametrize("chosen", ["source", "theta", "disturbance"])
def test_windows_choose_what_changed(chosen):
    physics = pendulum(true := 0.7 if chosen == "source" else LENGTH)
    if chosen == "disturbance":
        physics = hj.Hybrid(physics, ConstantDisturbance(jnp.array([0.0, 1.5])))
    found = adapt(hybrid(), flown(hj.Hybrid(physics, hybrid().residual)))
    assert found.chosen == chosen
    assert found.candidates[chosen] == max(found.candidates.values())
    pushed = [0.0, 1.5] if chosen == "disturbance" else None
    assert pushed is found.disturbance is None or np.allclose(found.disturbance, pushed, atol=0.2)
    length = found.parameters["log_length"]
    assert abs(length.value - np.log(true)) < 4 / 1.96 * (length.high - length.value) < 0.2
    words = {"source": "no change", "theta": "new physical parameters"}
    words |= {"disturbance": "new physical parameters and a constant disturbance"}
    assert f"Chosen: {chosen}, that is, {words[chosen]}. Probability of each change: {chosen}" in found.report()
    assert chosen != "source" or eqx.tree_equal(found.field.physics, hybrid().physics)
    assert ("Kept as before: all parameters" in found.report()) == (chosen == "source")


def test_a_step_of_the_network_is_taken_if_the_source_does_not_err_as_much():
    truth = eqx.tree_at(lambda field: field.residual.bias_out, hybrid(), hybrid().residual.bias_out + 1.0)
    windows, blocks = flown(truth), blocks_of(40, 5)
    equations = subspace(hybrid(), windows, None, None, None)
    fit = eqx.filter_jit(lambda error: fit_anchored(equations, jnp.zeros(()), error, blocks, blocks))
    found = [fit(jnp.asarray(error)) for error in (0.0, 1e9)]
    assert min(found[0].odds, found[1].naive) > STRONG > found[1].odds
    after = rollout_mse(with_change(hybrid(), found[0].change), windows)
    assert after < 0.1 * rollout_mse(hybrid(), windows)
    assert np.linalg.norm(found[1].change) < 1e-3 * np.linalg.norm(found[0].change)


@pytest.mark.parametrize("known", [True, False])
def test_without_its_training_windows_a_source_changes_only_by_more_than_its_network_may_err(known):
    strong = jax.tree.map(lambda leaf: 10 * leaf, hybrid().residual)
    source = eqx.tree_at(lambda field: field.residual, hybrid(LENGTH), strong)
    own = flown(source, seed=1) if known else None
    changed = (eqx.tree_at(lambda field: field.physics, source, pendulum(each * LENGTH)) for each in (0.97, 0.7))
    chosen = [adapt(source, flown(each), learned_from=own).chosen for each in changed]
    assert chosen == ["theta" if known else "source", "theta"]


def test_physics_that_needs_no_network_takes_the_sources_place():
    network = jax.tree.map(lambda leaf: 0.3 * leaf, hj.residual_network(2, 1, jax.random.key(1), hidden=4, norm="none"))
    source = hj.Hybrid(pendulum(0.68), network)
    found = adapt(source, flown(pendulum(LENGTH)), learned_from=flown(pendulum(0.7), seed=1))
    assert (found.physics_only, found.chosen) == (True, "theta")
    assert found.parameters["log_length"].low < np.log(LENGTH) < found.parameters["log_length"].high
    x, u = jnp.array([0.3, 0.1]), jnp.zeros(1)
    np.testing.assert_allclose(found.field(x, u), found.field.physics(x, u), atol=1e-6)
    assert "Physics without the network predicts" in found.report()


def test_errors_of_parameters_that_physics_inherits_come_from_ten_times_as_many_windows():
    """Its distance from the least error of these counts as well."""
    known, new = (flown(pendulum(0.7), count, noise=0.05, seed=1) for count in (400, 40))
    network = jax.tree.map(lambda leaf: 10 * leaf, hybrid().residual)

    def variance(away: float, count: int) -> float:
        larger, physics, sizes = auto._begin(auto.Auto(), hj.Hybrid(pendulum(0.7 * np.exp(away)), network), new)
        options = sizes, None, None, 100
        _, found = auto.judge_source(larger, physics, known[:count], new, options, blocks=10, networks=True)
        assert (bool(found.alone), found.degrees) == (True, count - len(sizes))
        return float(found.covariance[0, 0])

    least = float(hj.fit_least_squares(pendulum(0.7), known).field.log_length) - np.log(0.7)
    small, large = variance(least, 400), variance(least, 40)
    assert small == pytest.approx(large / 10, rel=0.4)
    assert variance(least + 0.01, 400) - small == pytest.approx(1e-4, rel=0.2)


def test_candidates_of_a_rigid_body_fit_what_their_names_say():
    def fitted(field):
        names = np.array([*named_parameters(field)])
        return names, {name: {*names[each].tolist()} for name, each in free_parameters(field).items()}

    field, dragged = (extended(body, 13) for body in (hj.rigid_body(hj.IRIS), hj.rigid_body(hj.IRIS, ("Ix", "drag"))))
    names, found = fitted(field)
    others = {"disturbance", "wind", "aerodynamics"}
    assert [*found] == [name for name, groups in CANDIDATES.items() if others.isdisjoint(groups)]
    assert len(names) == ravel_parameters(field)[0].size == 3 + 4 + 1 + 1 + 2 + 3 + 6
    assert (found["source"], found["theta"]) == (set(), {"Ix", "Iy", "k"})
    assert found["drag"] == {"Ix", "Iy", "k", *(f"added_drag[{i}]" for i in range(3))}
    # Four efficiencies and k would be five numbers for four.
    assert found["efficiency"] == {"Ix", "Iy", *(f"efficiency[{i}]" for i in range(4))}
    held, free = (fitted(dragged)[1][name] for name in ("theta", "theta_aerodynamics"))
    assert (held, free) == ({"Ix"}, {"Ix", *(f"drag[{i}]" for i in range(3))})


def test_a_heavy_penalty_holds_fine_tuning_at_the_source():
    windows, source = flown(hybrid(LENGTH)), hybrid()
    methods = (FineTune(rates=1e-3, max_epochs=40, l2_sp=weight) for weight in (0.0, 1e4))
    fields = [adapt(source, windows, method=method).field for method in methods]
    moved = [float(jnp.abs(ravel_parameters(each)[0] - ravel_parameters(source)[0]).max()) for each in fields]
    assert moved[1] < 0.2 * moved[0]


def test_outliers_are_set_aside_and_other_samples_are_used_as_they_are():
    windows = flown(hybrid(LENGTH), count=43)
    start, x = np.array(windows.x0), np.array(windows.x)
    x[7, 3, 1] += 3.0  # one bad sample, and a sensor that fails for a window
    x[20] += np.random.default_rng(0).normal(size=x[20].shape)
    start[30] += 0.5
    found = adapt(hybrid(), replace(windows, x0=start, x=x))
    assert found.set_aside == 2 * windows.horizon + 1
    assert f"Set aside: {found.set_aside} samples" in found.report()
    x[7, 3, 1] = np.nan
    left = adapt(hybrid(), replace(windows, x=x)[np.setdiff1d(np.arange(43), (20, 30))])
    assert (left.set_aside, left.windows, left.parameters) == (0, 41, found.parameters)
    linear = adapt(hybrid(), replace(windows, x=x), method="linear_residual")
    assert linear.mse_after < linear.mse_before / 2
    start[::2] += 0.5
    with pytest.warns(UserWarning, match="22 of 43 begin with an outlier"):
        assert not adapt(hybrid(), replace(windows, x0=start), method="source").set_aside


class Network(hj.AbstractVectorField):
    """A network, as far as `adapt` knows: damping, and a share of gravity."""

    rates: jax.Array

    def __call__(self, x, u):
        return jnp.stack([jnp.zeros_like(x[0]), -self.rates[0] * x[1] - self.rates[1] * jnp.sin(x[0])])


def learned(damping, share, unstable=0.0):
    """Adapt to a longer pendulum; the source predicts its own motion exactly, and its length makes up for the share."""
    network, known = Network(jnp.array([damping + unstable, share])), Network(jnp.array([damping, 0.0]))
    before, after = (hj.Hybrid(pendulum(length), known) for length in (0.7, LENGTH))
    physics = hj.Hybrid(pendulum(9.81 / (9.81 / 0.7 - share)), Network((-unstable, 0.0)))  # diverges if it is alone
    return adapt(hj.Hybrid(physics, network), flown(after), learned_from=flown(before, seed=1))


@pytest.mark.parametrize(("share", "widest"), [(0.0, 0.005), (1.5, 0.4), (5.0, 1.5), (0.0, np.inf)])
def test_an_interval_is_as_wide_as_the_network_s_possible_share(share, widest):
    found = learned(0.001, share, unstable=0.0 if np.isfinite(widest) else 600.0)
    one = found.parameters["log_length"]
    assert found.changed == ("log_length",)
    assert one.low < np.log(LENGTH) < one.high
    assert share / 10 < one.high - one.low < widest
    low, high = one.change  # does not depend on the share
    assert low < one.value - one.before < high < min(0.0, low + 0.005)


def test_the_network_takes_from_a_parameter_what_a_block_of_windows_would_move_it():
    """Also if the mean over blocks is zero, as after physics was fitted first; other effects take nothing."""
    columns = np.linalg.qr(np.random.default_rng(0).normal(size=(50, 3)))[0]
    jacobian = np.broadcast_to(columns[:, :2], (20, 50, 2))  # the third column is an effect of no parameter
    gram, signs = np.einsum("nep,neq->npq", jacobian, jacobian), np.repeat([1, -1, 1, -1, 0], 4)  # 4 in a block
    score = np.einsum("nep,ne->np", jacobian, signs[:, None] * (0.3 * columns[:, 0] + 5.0 * columns[:, 2]))
    equations = NormalEquations(jnp.asarray(gram), jnp.zeros((20, 2)), jnp.zeros(20))
    found = taken_by_network(equations, jnp.asarray(score), blocks_of(20, 5))
    np.testing.assert_allclose(found, [0.8 * 0.3**2, 0.0], atol=1e-6)


def test_results_of_auto_are_pooled_with_what_the_networks_express():
    pooled = hj.pool([learned(0.3, share) for share in (-1.5, 0.5, 1.0)])["log_length"]
    assert pooled.low < np.log(LENGTH) < pooled.high


def test_one_window_warns_and_a_source_without_its_motion_says_how_to_add_it(monkeypatch):
    with pytest.warns(UserWarning, match="windows: 1 are too few to determine 1 parameters"):
        assert adapt(pendulum(), flown(pendulum(), count=1)).chosen == "source"
    monkeypatch.setattr(auto.Auto, "solve", lambda self, field, *_, **__: Solution(field))
    with pytest.warns(UserWarning, match=r"its training windows are unknown.*; pass learned_"):
        adapt(hybrid(), flown(hybrid()))


class Stiff(hj.AbstractVectorField):
    """A slow state, and one that follows it within a tenth of a millisecond: no window tells how fast."""

    log_rate: jax.Array
    log_fast: jax.Array = eqx.field(default_factory=lambda: jnp.log(1e4))

    def __call__(self, x, u):
        slow = u[0] - jnp.exp(self.log_rate) * x[0] - 0.1 * x[1] ** 2
        return jnp.stack([slow, jnp.exp(self.log_fast) * (jnp.sin(x[0]) - x[1])])


def test_a_stiff_system_is_adapted_to_the_same_rate_from_near_and_far():
    """From far, the starts of windows must be smoothed again: around the source alone the rate is 1 % too high."""
    solver, random = diffrax.Kvaerno3(), np.random.default_rng(0)
    slow, u = random.normal(size=(30, 1)), random.normal(size=(30, 10, 1)).astype("f4")
    x0 = np.concatenate([slow, np.sin(slow)], axis=1).astype("f4")
    x = np.asarray(hj.rollout_batch(Stiff(jnp.log(0.5)), x0, u, 0.1, solver))
    noisy = [(each + 0.005 * random.normal(size=each.shape)).astype("f4") for each in (x0, x)]
    windows, settings = hj.Trajectories(noisy[0], u, noisy[1], dt=0.1), hj.Settings(solver=solver)
    far, near = (adapt(Stiff(jnp.log(rate)), windows, settings=settings) for rate in (0.3, 0.48))
    assert (far.converged, near.converged) == (True, True)
    one, other = (each.parameters["log_rate"] for each in (far, near))
    assert one.low < np.log(0.5) < one.high < one.low + 0.02
    assert "do not determine log_fast" in far.report()
    assert one.value == pytest.approx(other.value, abs=0.1 * (other.high - other.low))


def test_a_fit_that_diverges_from_the_first_estimate_begins_again_at_the_source(monkeypatch):
    fits = auto.fit_pair

    def diverging(field, move, *options):
        nothing, found, starts = fits(field, move, *options)
        return nothing, found._replace(status=Status.DIVERGED if np.any(move) else found.status), starts

    monkeypatch.setattr(auto, "fit_pair", diverging)
    assert adapt(pendulum(0.7), flown(pendulum())).converged


def example(key, scaling):
    """README's example: an exact record of a damped pendulum, and a model that does not know the damping."""
    weights, order, *draws = jax.random.split(key, 5)

    def windows(length, count, key):
        starts, inputs = jax.random.split(key)
        x0, u = jax.random.normal(starts, (count, 2)), jax.random.normal(inputs, (count, 10, 1))
        truth = hj.Hybrid(pendulum(length), Network(jnp.array([0.3, 0.0])))
        return hj.Trajectories(x0, u, eqx.filter_jit(hj.rollout_batch)(truth, x0, u, 0.05), dt=0.05)

    options = {"hidden": 16, "norm": "none", "activation": "tanh", "scaling": scaling}
    model = hj.Hybrid(pendulum(1.0), hj.residual_network(2, 1, weights, **options))
    source = hj.fit(model, windows(0.7, 300, draws[0]), windows(0.7, 100, draws[1]), order, max_epochs=200).best
    return adapt(source, windows(0.8, 20, draws[2]))


@pytest.mark.parametrize("keys", [4, pytest.param(100, marks=pytest.mark.slow)])
def test_the_interval_of_readme_s_example_contains_the_length(keys):
    """The source's own length is 1 to 5 % too large, as a longer pendulum resembles one with damping."""
    scaling = ChannelScaling(output=(0.1, 1.0))  # one for all, so that one program serves
    found = [example(key, scaling).parameters["log_length"] for key in jax.random.split(jax.random.key(7), keys)]
    assert np.mean([one.low <= np.log(0.8) <= one.high for one in found]) >= 0.9
    assert np.median([one.high - one.low for one in found]) < 0.25
