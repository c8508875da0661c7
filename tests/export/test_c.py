"""C of a field is the field: values, steps and their Jacobians, in both precisions, and without a warning."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from choices import slow
from compiled import Library, needs_compiler
from fields import KEY, SOME_SLOW, body, close, double, field_of, samples
from surface import refusal

import hybrid_jax as hj
from hybrid_jax.export import export_c
from hybrid_jax.integrate import rk4_step
from hybrid_jax.networks import multirotor_network, smoothed

pytestmark = needs_compiler
DT = 0.02
TOLERANCE = {True: 1e-12, False: 1e-5}  # of the largest entry


def check(field, folder, precisions=(True, False), steps=True, sizes=(13, 4), points=None):
    """Compare with JAX in double precision, in slopes along a random direction: a wrong entry of a Jacobian shows."""
    points = samples(2) if points is None else points
    points = [np.asarray(part, np.float32) for part in points]  # the same in both precisions
    rng = np.random.default_rng(2)
    dx, du = (rng.normal(size=size) for size in sizes)
    with jax.enable_x64(True):
        exact = double(field)
        functions = {"derivative": exact} | ({"step": lambda x, u: rk4_step(exact, x, u, DT)} if steps else {})
        expected = {}
        for name, function in functions.items():
            pushed = jax.jit(lambda x, u, function=function: jax.jvp(function, (x, u), (dx, du)))
            expected[name] = [pushed(*map(jnp.float64, point)) for point in zip(*points, strict=True)]
    for precise in precisions:
        name = f"model_{'d' if precise else 'f'}"
        options = {"state_size": sizes[0], "input_size": sizes[1], "double": precise}
        library = Library(export_c(folder, field, DT, name=name, **options)[1], sizes, precise)
        for function, results in expected.items():
            for (value, slope), x, u in zip(results, *points, strict=True):
                close(library(function, x, u), value, TOLERANCE[precise])
                again, by_x, by_u = library(f"{function}_jacobian", x, u)
                close(again, value, TOLERANCE[precise])
                close(by_x.astype(float) @ dx + by_u.astype(float) @ du, slope, TOLERANCE[precise])


@pytest.mark.parametrize("name", SOME_SLOW)
def test_it_is_the_field(name, tmp_path):
    """In steps, which are the same code for all, only those that follow."""
    check(field_of(name), tmp_path, precisions=(True,), steps=False)


def wide(norm="batch", **options):
    return hj.Hybrid(body(), multirotor_network(hj.IRIS, KEY, hidden=64, norm=norm, **options))


WIDE = {
    "paper": wide,
    "layer norm": lambda: wide("layer"),
    "invariant": lambda: wide("none", inputs="no_xy_yaw", outputs="accelerations"),
    "smooth": lambda: smoothed(wide(), 30.0),
    **{name: lambda name=name: wide(activation=name) for name in ("softplus", "tanh", "silu")},
    "least squares": lambda: hj.with_disturbance(wide()),
}


@pytest.mark.parametrize(
    "name", ["paper", "layer norm", "invariant", "silu", *slow("softplus", "tanh", "smooth", "least squares")]
)
def test_layers_that_are_loops_are_the_network(name, tmp_path):
    check(WIDE[name](), tmp_path)


def turned(x, u):
    return jnp.stack([x[1], u[0] * jnp.where(x[0] > 0, 2.0, jnp.exp(x[0])) - x[1] ** 3 + jnp.maximum(x[0], -0.5)])


def rows(x, u):
    """Beside each other constants, what all rows have in common, a logical and a number of each row."""

    def one(row):
        place, entry, above = row
        return place * jnp.where((x[0] > 0) & above, jnp.sin(entry), entry * u[0])

    return jax.lax.map(one, (jnp.arange(3.0), x, x > u[0]))


def steps(x, u):
    """Half of it is carried on; each turn gives a number of its own, and reads one."""
    halved = jax.lax.fori_loop(0, 3, lambda i, y: y / 2 + i * u[0], x)

    def one(carried, row):
        y, z = carried
        return (jnp.sin(y) * row, z + y[0]), y[0] * z

    (y, z), numbers = jax.lax.scan(one, (halved, u[0]), jnp.arange(3.0))
    return y + z * numbers


@pytest.mark.parametrize(("function", "size"), [(turned, 2), (rows, 3), (steps, 3)])
def test_a_function_of_one_s_own_of_any_size_a_map_over_rows_and_a_loop_may_be_one(function, size, tmp_path):
    rng = np.random.default_rng(0)
    check(function, tmp_path, sizes=(size, 1), points=(rng.normal(size=(4, size)), rng.normal(size=(4, 1))))


def backward(function, x):
    return jax.lax.scan(lambda y, _: (function(y), None), x, length=3, reverse=True)[0]


def test_what_is_not_a_number_is_not_hidden(tmp_path):
    library = Library(export_c(tmp_path, wide(), DT)[1], (13, 4), double=False)
    x, u = (part[0] for part in samples())
    assert np.isfinite(library("step", x, u)).all()
    x[10] = np.nan
    assert np.isnan(library("step", x, u)).all()


def test_what_makes_no_c_is_refused(tmp_path):
    for name in ("1f", "Model", "a-b", "", None, "math"):
        with pytest.raises(ValueError, match="name must be a lower-case C identifier"):
            export_c(tmp_path, body(), DT, name=name)
    refusal(lambda: export_c(tmp_path, body(), 0.0), "dt must be a positive")
    refusal(lambda: export_c(tmp_path, body(), DT, smooth=-1.0), "smooth must be")
    for said, loop in (("'while'", partial(jax.lax.while_loop, lambda y: y[0] > 1)), ("'scan' from the end", backward)):
        with pytest.raises(ValueError, match=rf"operation {said} has no counterpart in C$"):
            export_c(tmp_path, lambda x, u, loop=loop: loop(lambda y: y / 2, x), DT, state_size=2, input_size=1)
    assert not list(tmp_path.iterdir())
