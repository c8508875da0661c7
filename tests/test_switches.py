"""JAX's own switches, set for code of the user, do not stop the library; transformations are refused in one line."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pendulum
import pytest

import hybrid_jax as hj
from hybrid_jax import export

SWITCHES = {
    "x64": lambda: jax.enable_x64(True), "strict types": lambda: jax.numpy_dtype_promotion("strict"),
    "strict ranks": lambda: jax.numpy_rank_promotion("raise"), "NaN is an error": lambda: jax.debug_nans(True),
}  # fmt: skip
pytestmark = pytest.mark.filterwarnings("ignore")


def hybrid():
    network = hj.residual_network(2, 1, jax.random.key(0), hidden=4, norm="none", activation="tanh")
    return hj.Hybrid(pendulum.Pendulum(jnp.float32(0.0)), network)


def windows(n=12):
    flights = pendulum.swings(n)
    parts = (np.asarray(part, np.float32) for part in (flights.x0, flights.u, flights.x))
    return hj.Trajectories(*parts, flights.dt)


def filtered(_):
    estimator = hj.OnlineAdaptation(hybrid(), windows().dt, 1e-3)
    state = estimator.begin(windows().x0[0])
    return estimator.estimate(estimator.update(state, windows().x[0, 0], windows().u[0, 0]))


def exported(folder):
    export.export_c(folder / "c", hybrid(), 0.01)
    export.export_program(folder / "program.bin", hybrid(), 0.01)
    return jnp.zeros(())


WORK = {
    "fit": lambda _: hj.fit(hybrid(), windows(), windows(6), jax.random.key(1), max_epochs=2).best,
    "fit_gauss_newton": lambda _: hj.fit_gauss_newton(hybrid(), windows(), max_steps=2).field,
    "filter": filtered,
    "export": exported,
    **{method: lambda _, by=method: hj.adapt(hybrid(), windows(), method=by).field for method in hj.METHODS},
}


@pytest.mark.slow
@pytest.mark.parametrize("switch", SWITCHES)
@pytest.mark.parametrize("work", WORK)
def test_the_library_works_whatever_jax_is_told(work, switch, tmp_path):
    with SWITCHES[switch]():
        found = WORK[work](tmp_path)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(eqx.filter(found, eqx.is_inexact_array)))


def test_a_transformation_of_what_decides_by_numbers_is_refused_in_one_line():
    data, field = windows(), hybrid()
    arrays, rest = eqx.partition(field, eqx.is_array)
    for function in (hj.fit_gauss_newton, hj.adapt):
        with pytest.raises(TypeError, match=r"cannot be called under jax.jit.*sweep"):
            jax.jit(lambda arrays, function=function: function(eqx.combine(arrays, rest), data).field)(arrays)
    with pytest.raises(TypeError, match=r"adapt cannot be called under jax.jit.*sweep"):
        jax.vmap(lambda x: hj.adapt(field, hj.Trajectories(data.x0, data.u, x, data.dt)).field)(np.stack(2 * [data.x]))
    keys = jax.random.split(jax.random.key(0))
    with pytest.raises(TypeError, match=r"fit cannot be called under jax.jit.*sweep"):
        jax.vmap(lambda key: hj.fit(field, data, data, key).best)(keys)
