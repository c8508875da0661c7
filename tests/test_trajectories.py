"""Laws of windows cut from flights, and of the metrics on them."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from pendulum import pendulum, swings

from hybrid_jax import metrics
from hybrid_jax.integrate import rollout_batch
from hybrid_jax.trajectories import Trajectories, check, concatenate, windows_of

STEPS = 5


def flight(intervals=23, seed=0):
    rng = np.random.default_rng(seed)
    return rng.normal(size=(intervals + 1, 3)), rng.normal(size=(intervals, 2))


def windows():
    return windows_of(*flight(), 0.01, steps=STEPS)


def test_windows_partition_a_flight():
    states, inputs = flight()
    cut = windows_of(states, inputs, 0.01, steps=STEPS)
    assert (len(cut), cut.horizon, cut.dt) == (4, STEPS, 0.01)
    np.testing.assert_array_equal(np.concatenate(cut.u), inputs[:20])
    np.testing.assert_array_equal(np.concatenate(cut.x), states[1:21])
    np.testing.assert_array_equal(cut.x0, states[[0, 5, 10, 15]])
    assert check(cut) is cut


def test_with_a_stride_windows_overlap():
    states, inputs = flight()
    cut = windows_of(states, inputs, 0.01, steps=STEPS, stride=2)
    assert len(cut) == 10  # starts 0, 2, …, 18; the window from 18 ends with the flight
    np.testing.assert_array_equal(cut.x[-1, -1], states[-1])
    np.testing.assert_array_equal(cut.u[3], inputs[6:11])


@pytest.mark.parametrize(("intervals", "steps", "stride"), [(4, 5, None), (23, 0, None), (23, 5, 0), (23, 5, -1)])
def test_a_flight_without_a_window_is_refused(intervals, steps, stride):
    with pytest.raises(ValueError, match=r"has no window of steps|st(eps|ride) must be an integer of at least 1"):
        windows_of(*flight(intervals), 0.01, steps=steps, stride=stride)


def test_concatenate_keeps_order_takes_any_iterable_and_refuses_what_does_not_fit():
    a, b = windows(), windows_of(*flight(seed=1), 0.01, steps=STEPS)
    joined = concatenate([a, b])
    np.testing.assert_array_equal(joined.x[4:], b.x)
    for other in (replace(b, dt=0.02), windows_of(*flight(), 0.01, steps=4)):
        with pytest.raises(ValueError, match=r"^windows must share dt and horizon"):
            concatenate([a, other])
    with pytest.raises(ValueError, match=r"^windows must contain at least one Trajectories, but the list is empty"):
        concatenate([])
    np.testing.assert_array_equal(concatenate(iter([a, a])).x, concatenate([a, a]).x)
    for other in (a, [a, a.x], "ab"):
        with pytest.raises(ValueError, match=r"^windows must be a list of Trajectories, got "):
            concatenate(other)


def test_windows_are_picked_by_slices_and_by_traced_indices():
    cut = windows()
    np.testing.assert_array_equal(cut[1:3].u, cut.u[1:3])
    picked = jax.jit(lambda index, windows: windows[index])(jnp.array([3, 0]), jax.tree.map(jnp.asarray, cut))
    np.testing.assert_array_equal(picked.x, cut.x.astype(np.float32)[[3, 0]])
    assert picked.dt == cut.dt


BAD = [({"dt": dt}, "dt must be a positive number") for dt in (0.0, -0.01, np.nan, np.inf)]
BAD += [({part: np.s_[..., :-1, :]}, "trajectories: shapes of x0 .* do not agree") for part in ("x0", "u", "x")]
BAD += [({"u": value}, r"trajectories: u\[1, 3, 0\] is not finite") for value in (np.nan, np.inf, -np.inf)]


@pytest.mark.parametrize(("changes", "said"), BAD)
def test_what_is_wrong_with_windows_is_named(changes, said):
    cut = windows()
    for part, change in changes.items():
        if isinstance(change, tuple):
            cut = replace(cut, **{part: getattr(cut, part)[change]})
        elif part == "u":
            cut.u[1, 3, 0] = change
        else:
            cut = replace(cut, dt=change)
    with pytest.raises(ValueError, match=said):
        check(cut)


def test_single_and_empty_windows_are_refused():
    nothing = Trajectories(np.zeros((2, 3)), np.zeros((2, 0, 1)), np.zeros((2, 0, 3)), 0.1)
    for wrong, said in ((windows()[0], "must have 2, 3, 3 axes"), (windows()[:0], "is empty"), (nothing, "is empty")):
        with pytest.raises(ValueError, match=said):
            check(wrong)


@pytest.mark.parametrize(("every", "chunk"), [(1, 250), (2, 7), (4, 250), (8, 20)])
def test_an_error_is_the_definition_at_every_so_many_intervals(every, chunk, monkeypatch):
    monkeypatch.setattr(metrics, "CHUNK", chunk)
    windows, field = swings(20), pendulum(0.6)
    predicted = np.asarray(rollout_batch(field, windows.x0, windows.u, windows.dt), np.float64)
    squares = np.square(predicted - np.asarray(windows.x)).sum(-1)
    rows = [i for i in range(8) if (i + 1) % every == 0]
    found = metrics.rollout_mse(field, windows, every)
    np.testing.assert_allclose(found, squares[:, rows].mean(), rtol=1e-5)  # float32 sums of 160 numbers


def test_mse_by_hand():
    truth = jnp.zeros((2, 2, 3))
    predicted = jnp.array([[1.0, 2.0, 2.0], [0.0, 3.0, 4.0]])
    both = metrics.mse(jnp.stack([predicted, 2 * predicted]), truth)
    np.testing.assert_array_equal(both, [17, 68])  # squared norms, mean over time: not over the elements


def test_an_error_beyond_float_is_not_finite():
    lost = pendulum(damping=-1e6)
    assert not jnp.isfinite(metrics.rollout_mse(lost, swings(20)))
