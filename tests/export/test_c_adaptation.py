"""The C of an `OnlineAdaptation` is the filter, through samples that are missing and after a change."""

import ctypes
from dataclasses import replace
from functools import cache

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiled import C99, needs_compiler, run
from fields import double
from jax.flatten_util import ravel_pytree

import hybrid_jax as hj
from hybrid_jax.export import export_adaptation_c, export_filter_c
from hybrid_jax.export.c.filters import _about
from hybrid_jax.integrate import rk4_step

pytestmark = needs_compiler
DT = 0.01
# θ, the last good θ and the sums of corrections are in standard deviations of the prior. An innovation is a difference
# of two nearly equal numbers: a last digit of 2 m is 1e-4 of a noise of 1 mm, so θ near zero has few right digits.
UNITS = dict.fromkeys(("theta", "trusted", "settled", "pull", "nis", "z"), 1.0)
UNITS |= {"spread": 1e-3, "log_weights": 25.0, "evidence": 25.0, "away": 1.0, "sensitivity": 1e-2}
HYPOTHESES = (
    hj.Hypothesis("spring", {"stiffness": 0.3}),
    hj.Hypothesis("motor", {"gain": 0.3}),
    hj.Hypothesis("wind", {"disturbance[1]": 2.0}, rates={"disturbance[1]": 1.0}, lead=0.1),
)


class Cart(hj.AbstractVectorField):
    """x = (position, velocity): small, as each hypothesis has a filter of all states."""

    stiffness: jax.Array
    gain: jax.Array

    def __call__(self, x, u):
        return jnp.stack([x[1], self.gain * u[0] - self.stiffness * x[0]])


NOMINAL = {True: Cart(jnp.ones(()), jnp.ones(())), False: hj.rigid_body(hj.IRIS)}  # with hypotheses, and alone
AWAY = {True: (0.3, 0.05), False: (0.3, -0.3, 0.05)}  # from the nominal parameters


@cache
def flight(hypotheses, steps=90):
    """Samples, inputs and periods of a system that is not nominal and that weakens; one sample is missing, another
    frozen, and one comes after a gap."""
    rng, ahead, samples = np.random.default_rng(0), eqx.filter_jit(rk4_step), []
    leaves, structure = jax.tree.flatten(NOMINAL[hypotheses])
    x = jnp.zeros(2) if hypotheses else jnp.zeros(13).at[2].set(2.0).at[3].set(1.0)
    inputs = 2 * rng.normal(size=(steps, 1)) if hypotheses else hj.IRIS.hover_speed + 40 * rng.normal(size=(steps, 4))
    for i, u in enumerate(inputs := inputs.astype(np.float32)):
        away = AWAY[hypotheses] if i < 74 else (*AWAY[hypotheses][:-1], -0.7)
        x = ahead(structure.unflatten([leaf + by for leaf, by in zip(leaves, away, strict=True)]), x, u, DT)
        samples.append(np.asarray(x) + 1e-3 * rng.normal(size=len(x)).astype(np.float32))
    samples[10][:] = np.nan
    samples[11][4 % len(x)] = np.nan
    samples[13][7 % len(x) : 10] = samples[12][7 % len(x) : 10]
    return list(zip(np.array(samples, np.float32), inputs, np.where(np.arange(steps) == 21, 20.0, 1.0), strict=True))


@cache
def in_double(hypotheses):
    """The filter in double precision, and one program of its update for both precisions of C."""
    exact = double(filter_with(hypotheses))
    return exact, jax.jit(lambda *given: exact.update(*given))


def filter_with(hypotheses):
    own = {"hypotheses": HYPOTHESES, "prior": 0.5, "indices": (1,)} if hypotheses else {}
    return hj.OnlineAdaptation(NOMINAL[hypotheses], DT, 1e-3, disturbance=2.0, process=1e-2, **own)


def compiled(source, precise, size):
    """The two functions of the C, each of arrays and then of numbers, and of one array that it fills."""
    run("gcc", *C99, "-O0", "-fPIC", "-shared", source, "-o", source.with_suffix(".so"), "-lm")
    library = ctypes.CDLL(str(source.with_suffix(".so")))
    dtype, real = (np.float64, ctypes.c_double) if precise else (np.float32, ctypes.c_float)

    def filled(function, *arrays, numbers=()):
        held = [np.ascontiguousarray(array, dtype) for array in (*arrays, np.full(size, np.nan))]
        places = [ctypes.c_void_p(array.ctypes.data) for array in held]
        function(*places[:-1], *map(real, numbers), places[-1])
        return held[-1]

    def update(state, x, u, *numbers):
        return filled(library[f"{source.stem}_update"], state, x, u, numbers=numbers)

    return lambda *given: filled(library[f"{source.stem}_begin"], *given), update


def error(found, expected):
    """The largest difference, relative to the largest number of its part of the state or to the unit of that.

    Covariances take the place of their square roots, of which some columns are rounding only.
    """

    def off(path, value, other):
        if (name := path[-1].name) == "root":
            value, other = (root @ np.swapaxes(root, -1, -2) for root in (value, other))
        return np.abs(other - value).max() / max(np.abs(value).max(), UNITS.get(name, 1e-9))

    states = jax.device_get((expected, found))  # NumPy compiles nothing
    return max(jax.tree.leaves(jax.tree_util.tree_map_with_path(off, *states)))


@pytest.mark.parametrize("hypotheses", [False, True], ids=["alone", "hypotheses"])
@pytest.mark.parametrize(("precise", "allowed"), [(True, 1e-12), (False, 4e-5)])
def test_c_is_the_filter(precise, allowed, hypotheses, tmp_path):
    adaptation, ((first, u, _), *samples) = filter_with(hypotheses), flight(hypotheses)
    sizes = {"state_size": len(first), "input_size": len(u)}
    with jax.enable_x64(True):
        exact, update_of_jax = in_double(hypotheses)
        state = exact.begin(jnp.asarray(first, float))
        flat, unravel = ravel_pytree(state)
        source = export_adaptation_c(tmp_path, adaptation, double=precise, **sizes)[1]
        begin, update = compiled(source, precise, flat.size)
        flown = begin(first)
        np.testing.assert_array_equal(flown, np.asarray(flat, flown.dtype))
        for x, u, periods in samples:
            arguments = [jnp.asarray(part, float) for part in (x, u, periods)]
            before = np.asarray(ravel_pytree(state)[0], flown.dtype)
            expected = update_of_jax(unravel(jnp.asarray(before, float)), *arguments)
            after = unravel(jnp.asarray(update(before, x, u, periods), float))
            assert error(after, expected) < allowed  # one step from the same numbers
            state, flown = update_of_jax(state, *arguments), update(flown, x, u, periods)
        assert state.changes >= 1  # an alarm is among what was compared
        # Errors of a whole flight add up: JAX in single precision differs by 3e-6 from itself in double.
        assert error(unravel(jnp.asarray(flown, float)), state) < 10 * allowed


def test_c_is_the_filter_of_hidden_states(tmp_path):
    """Of a quadrotor of which position and attitude are measured in turn, with an unknown force."""
    field = hj.with_hidden(hj.rigid_body(hj.IRIS), hj.dynamics.RandomWalk((7, 8, 9)))
    start, spread = (0.0, 0.0, 2.0, 1.0, *np.zeros(12)), (*np.full(12, 0.1), 2.0, 2.0, 2.0)
    system = hj.StateSpaceModel(field, ("speeds",), start=start, spread=spread, process=(*np.zeros(12), 1, 1, 1))
    seen = replace(system.only(["position", "attitude"]), noise={"position": 0.01, "attitude": 0.02})
    kalman = hj.ExtendedKalmanFilter(seen, DT)
    source, rng = export_filter_c(tmp_path, kalman, double=True)[1], np.random.default_rng(0)
    speeds = hj.IRIS.hover_speed + 40 * rng.normal(size=(8, 4))
    samples = [0, 0, 2, 1, 0, 0, 0] + 0.01 * rng.normal(size=(8, 7))
    samples[::2, :3], samples[1::2, 3:] = np.nan, np.nan
    with jax.enable_x64(True):
        exact = double(kalman)
        jitted = jax.jit(lambda *given: exact.update(*given))
        state = exact.begin(samples[0])
        flat, unravel = ravel_pytree(state)
        begin, update = compiled(source, True, flat.size)
        flown = begin(samples[0], speeds[0])
        for x, u in zip(samples[1:], speeds[1:], strict=True):
            state, flown = jitted(state, x, u), update(flown, x, u)
        assert error(unravel(jnp.asarray(flown)), state) < 1e-12


def test_names_of_a_model_cannot_leave_their_comment():
    names = ["k*/ int main(void) {} /*", "disturbance[vx]", "β\n#error"]
    said = _about("adapts", {"trusted": (0, 1), "*/\\\n": (1, 2)}, names)
    assert "changes of k___int_main_void_______, disturbance[vx], ___error,\n" in said
    assert "state: trusted at 0 (1),\n   ____ at 1 (2).\n" in said
