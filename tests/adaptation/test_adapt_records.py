"""From records a change is taken over only if parts that were left out confirm it; all else stays at the source."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy
from pendulum import Biased, Damped

import hybrid_jax as hj
from hybrid_jax.adaptation.records import _candidates, _chosen, _more
from hybrid_jax.networks.mlp import zero_output
from hybrid_jax.networks.standardise import with_motion

NOISE, SECONDS = 0.01, 8.0


def model(length, damping, bias, spread):
    field, sensor = Damped(jnp.log(jnp.array(length)), jnp.array(damping)), Biased(jnp.array(bias))
    return hj.StateSpaceModel(field, ("push",), {"angle": sensor}, (0.0, 0.0), spread)


def record(seed, length=0.8, bias=0.1, push=2.0):
    """An angle with a bias and noise; without a push the pendulum hangs at rest."""
    random, t, measured = np.random.default_rng(seed), np.arange(0, SECONDS, 0.1), np.arange(0.0, SECONDS, 0.05)
    signal = t, push * random.normal(size=len(t))
    known = hj.Record.of("r", push=signal, angle=(measured, 0 * measured))
    start = np.array([random.uniform(-1, 1), 0.0]) if push else np.zeros(2)
    y = hj.simulate(model(length, 0.3, bias, (0, 0)), known, start, dt=0.02)[0]["angle"][:, 0]
    return hj.Record.of(f"run {seed}", push=signal, angle=(measured, y + NOISE * random.normal(size=len(y))))


@pytest.fixture(scope="module")
def source():
    found = hj.fit_records(model(1.0, 0.1, 0.0, (np.inf, np.inf)), [record(1), record(2)], dt=0.02)
    # The same start, so that one program serves all tests.
    return dataclasses.replace(found, model=dataclasses.replace(found.model, start=(0.0, 0.0)))


@pytest.mark.parametrize("push", [2.0, 0.0], ids=["unchanged", "at rest, whatever changed"])
def test_what_no_left_out_part_confirms_stays_at_the_source_to_the_bit(source, push):
    result = hj.adapt_records(source, [record(3, length=0.8 if push else 1.2, push=push)], dt=0.02)
    assert (result.chosen, result.changes) == ("source", {})
    assert eqx.tree_equal(result.fit, source)
    assert "No change is confirmed" in result.report()


def test_a_change_of_physics_is_found_with_its_interval_and_predicts_better(source):
    result, new = hj.adapt_records(source, [record(5, length=1.0)], dt=0.02), record(8, length=1.0)
    assert result.chosen == "physics"
    change = result.changes["log_length"]
    assert float(change.low) < np.log(1.0 / 0.8) < float(change.high) < 0.3
    assert float(change.value) == pytest.approx(float(result.model.field.log_length - source.model.field.log_length))
    assert result.model.outputs["angle"].bias == source.model.outputs["angle"].bias
    assert np.array(result.fit.intervals["angle.bias"]) == pytest.approx(np.array(source.intervals["angle.bias"]))
    past, future = new.part(0, 5), new.part(5, SECONDS)
    y = [hj.predict(each.model, past, future, dt=0.02)["angle"] for each in (source, result)]
    before, after = (np.std(each - future.signals["angle"].values[-len(each) :]) for each in y)
    assert after < before / 3
    assert "Changed: physics" in result.report()
    assert "change 0.2" in result.report()


def test_a_sensor_that_is_off_is_not_taken_for_other_physics_and_motion_that_a_network_has_not_seen_is_named(source):
    network = zero_output(hj.residual_network(2, 1, jax.random.key(0), hidden=4))
    slow = np.linspace(-0.05, 0.05, 60).reshape(10, 3, 2).astype(np.float32)
    seen = hj.Trajectories(slow[:, 0], slow[..., :1], slow, 0.02)
    trained = with_motion(hj.Hybrid(source.model.field, hj.Frozen(network)), seen)
    for given in (source, dataclasses.replace(source.model, field=trained)):  # a model is as good as its fit
        result = hj.adapt(given, [record(6, bias=0.3)], dt=0.02)  # the same as adapt_records
        assert (result.chosen, set(result.changes)) == ("sensors", {"angle.bias"})
        assert float(result.changes["angle.bias"].value) == pytest.approx(0.2, abs=0.01)
        assert eqx.tree_equal(result.model.field, source.model.field if given is source else trained)
        assert (given is source) == (result.outside == {}) == ("training range" not in result.report())


def test_a_larger_candidate_is_chosen_only_if_it_surely_beats_all_smaller_ones():
    still, better = np.full(8, 10.0), np.full(8, 5.0)
    noise = np.exp(0.1 * np.random.default_rng(0).normal(size=8))
    assert _chosen({"source": still, "physics": still * noise}) == "source"
    assert _chosen({"source": still, "sensors": better, "physics": better * noise}) == "sensors"
    assert _chosen({"source": still, "sensors": better, "physics": better / 2}) == "physics"
    assert _chosen({"source": still, "sensors": better, "physics": np.full(8, np.nan)}) == "sensors"
    assert _chosen({"source": still[:4], "physics": better[:4]}) == "source"  # too few parts to be sure


def test_numbers_that_differ_from_part_to_part_are_known_as_well_as_their_mean(source):
    of_parts = np.random.default_rng(0).normal(size=(7, 3)) * [0.0, 0.05, 50.0]
    without = (of_parts.sum(axis=0) - of_parts) / 6
    wider = _more(source, without)
    error = scipy.stats.sem(of_parts) * scipy.stats.t.ppf(0.975, 6) / 1.96
    np.testing.assert_allclose(wider, np.maximum(error / np.sqrt(np.diagonal(source.covariance)), 1), rtol=1e-3)
    assert wider[0] == 1 < wider[2]


def test_a_network_changes_only_together_with_all_others():
    hybrid = hj.Hybrid(model(1.0, 0.1, 0.0, (0, 0)).field, hj.residual_network(2, 1, jax.random.key(0), hidden=4))
    whole = dataclasses.replace(model(1.0, 0.1, 0.0, (0, 0)), field=hybrid)
    p = hj.dynamics.base.ravel_learned(whole)[0].size
    counts = {name: int(free.sum()) for name, free in _candidates(whole, p).items()}
    assert counts == {"source": 0, "sensors": 1, "physics": 2, "sensors and physics": 3, "all": p}


def test_wrong_inputs_are_named(source):
    unknown = dataclasses.replace(source.model, noise={})
    with pytest.raises(ValueError, match=r"^noise: angle has none"):
        hj.adapt_records(unknown, [record(4)], dt=0.02)
    with pytest.raises(ValueError, match=r"^source must be a RecordFit, got Damped"):
        hj.adapt_records(source.model.field, [record(4)], dt=0.02)
    with pytest.raises(ValueError, match=r"^method is for windows with measured states, not for records"):
        hj.adapt(source, [record(4)], dt=0.02, method="fine_tune")
    with pytest.raises(TypeError, match=r"^dt is an argument for records, which need a RecordFit"):
        hj.adapt(source.model.field, [record(4)], dt=0.02)
    with pytest.raises(ValueError, match=r"^prior cannot be given: it is determined by the source"):
        hj.adapt_records(source, [record(4)], dt=0.02, prior={"damping": 1.0})
