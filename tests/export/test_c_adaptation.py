"""The C of an `OnlineAdaptation` is the filter, through samples that are missing and after a change."""

import ctypes

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiled import C99, needs_compiler, run
from fields import double
from jax.flatten_util import ravel_pytree

import hybrid_jax as hj
from hybrid_jax.adaptation.online import OnlineAdaptation
from hybrid_jax.control import advance
from hybrid_jax.export import export_adaptation_c

pytestmark = needs_compiler
DT = 0.01


def flight(steps=30):
    """Samples and rotor speeds of an Iris whose inertia is not nominal; one sample is missing, another frozen."""
    rng = np.random.default_rng(0)
    truth = hj.RigidBody({"Ix": jnp.array(0.3), "Iy": jnp.array(-0.3), "k": jnp.array(0.05)}, hj.IRIS)
    x, samples = jnp.zeros(13).at[2].set(2.0).at[3].set(1.0), []
    speeds = (hj.IRIS.hover_speed + 40 * rng.normal(size=(steps, 4))).astype(np.float32)
    for u in speeds:
        x = advance(truth, x, u, DT)
        samples.append(np.asarray(x) + 1e-3 * rng.normal(size=13).astype(np.float32))
    samples[10][:] = np.nan
    samples[11][4] = np.nan
    samples[13][7:10] = samples[12][7:10]
    return np.array(samples, np.float32), speeds


@pytest.mark.parametrize("precise", [True, False])
def test_c_is_the_filter(precise, tmp_path):
    adaptation = OnlineAdaptation(hj.rigid_body(hj.IRIS), DT, 1e-3, disturbance=2.0, process=1e-2)
    samples, speeds = flight()
    source = export_adaptation_c(tmp_path, adaptation, double=precise)[1]
    library = tmp_path / "adaptation.so"
    run("gcc", *C99, "-O0", "-fPIC", "-shared", source, "-o", library, "-lm")
    functions, kind = ctypes.CDLL(str(library)), np.float64 if precise else np.float32
    with jax.enable_x64(True):
        exact = double(adaptation)
        state = exact.begin(jnp.asarray(samples[0], float))
        flat, unravel = ravel_pytree(state)
        found = np.zeros(flat.size, kind)

        def pointers(*arrays):
            kept = [np.ascontiguousarray(array, kind) for array in arrays]
            return kept, [array.ctypes.data_as(ctypes.c_void_p) for array in kept]

        kept, places = pointers(samples[0], found)
        functions.adaptation_begin(*places)
        found = kept[1]
        np.testing.assert_array_equal(found, np.asarray(flat, kind))
        update = jax.jit(lambda *given: exact.update(*given))
        real = ctypes.c_double if precise else ctypes.c_float
        for i, (x, u) in enumerate(zip(samples[1:], speeds[1:], strict=True)):
            periods = 20.0 if i == 20 else 1.0
            state = update(state, jnp.asarray(x, float), jnp.asarray(u, float), periods)
            kept, places = pointers(found, x, u, np.zeros(flat.size))
            functions.adaptation_update(*places[:3], real(periods), places[3])
            found = kept[3]
        again = unravel(jnp.asarray(found, float))
        assert again.changes == state.changes
        for name in ("x", "theta", "trusted", "covariance", "nis"):
            expected = np.asarray(getattr(state, name))
            scale = np.abs(expected).max()
            np.testing.assert_allclose(getattr(again, name), expected, rtol=0, atol=(1e-9 if precise else 2e-3) * scale)
