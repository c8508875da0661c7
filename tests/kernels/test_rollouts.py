"""The kernels of whole rollouts do what JAX does, and JAX does it where they do not serve."""

from dataclasses import replace
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array, Float
from systems import ODD

from benchmarks.subjects import DT, untrained
from hybrid_jax import IRIS, AbstractVectorField, Hybrid, Trajectories, kernels
from hybrid_jax.dynamics.base import as_field
from hybrid_jax.dynamics.rigid_body import LEARNED, RigidBody, rigid_body
from hybrid_jax.dynamics.terms import Terms
from hybrid_jax.integrate import RK4, integrate, rollout_batch
from hybrid_jax.kernels import library
from hybrid_jax.metrics import predict
from hybrid_jax.networks import multirotor_network
from hybrid_jax.networks.mlp import LinearSkip, residual_network
from hybrid_jax.networks.normalisation import ChannelScaling
from hybrid_jax.runtime import FAST_COMPILE
from hybrid_jax.training.loss import rollout_minibatch
from hybrid_jax.training.objective import Settings, compiler_options

PLACES = tuple((float(0.2 * np.cos(angle)), float(0.3 * np.sin(angle))) for angle in 0.1 + np.arange(6))
HEXACOPTER = replace(ODD, rotor_positions=PLACES, spin=(1.0, -1.0) * 3)
THETA = dict(zip(LEARNED, jnp.array([0.3, -0.4, 0.1]), strict=True))
BODY, LIFTED = RigidBody(THETA, ODD), Terms(drag=(0.3, 0.2, 0.1), translational_lift=0.1)
needs_kernels = pytest.mark.skipif(library.obstacle() is not None, reason=kernels.status())


def network(d, r, hidden=32, **options):
    """A network whose running statistics and biases are not those of the start, with scalings of all channels."""
    offset, scale, output = map(tuple, np.random.default_rng(d).uniform(0.5, 2, (3, d + r)).tolist())
    scaling = ChannelScaling(offset, scale, output[:d])
    made = residual_network(d, r, jax.random.key(r), hidden=hidden, scaling=scaling, **options)
    rng = np.random.default_rng(r)
    arrays, rest = eqx.partition(made, eqx.is_array)
    return eqx.combine(jax.tree.map(lambda a: a + rng.uniform(-0.2, 0.2, a.shape).astype(np.float32), arrays), rest)


FIELDS = {
    "the paper's": lambda: untrained("hybrid"),
    "physics alone": lambda: BODY,
    "no physics": lambda: network(3, 2, hidden=32),
    "no input, a number of units that fills no vector": lambda: network(5, 0, hidden=9, activation="tanh"),
    "a force and a torque": lambda: Hybrid(RigidBody(THETA, HEXACOPTER, wrench=True), network(13, 6)),
    "a vehicle's terms": lambda: Hybrid(
        rigid_body(ODD, ("Ix", "k_rotors", "drag", "centre_of_mass"), LIFTED),
        network(13, 4, norm="none", activation="tanh"),
    ),
    "a skip around a norm": lambda: Hybrid(BODY, LinearSkip(jnp.ones((13, 17)) / 10, network(13, 4))),
    "layer norm": lambda: network(4, 1, norm="layer", activation="silu"),
    "a view of the state": lambda: Hybrid(BODY, multirotor_network(IRIS, jax.random.key(2), inputs="no_xy", hidden=32)),
}
paper = FIELDS["the paper's"]


def windows(field, b, steps=3, lanes=()):
    body = getattr(field, "physics", field if isinstance(field, RigidBody) else None)
    d, r = (13, body.vehicle.rotors) if body else (field.state_size, field.input_size)
    rng = np.random.default_rng(b)
    x0, d_states = rng.normal(size=(*lanes, d, b)), rng.normal(size=(*lanes, steps, d, b))
    u = rng.normal(size=(*lanes, steps, r, b))
    if body:
        u = body.vehicle.hover_speed * (1 + 0.1 * u)
    return tuple(part.astype(np.float32) for part in (x0, u, d_states))


def trained(field, x0, u, dt=DT):
    return rollout_minibatch(field, x0, u, dt, RK4())


LOOP = RK4(scanned=True)  # the same numbers to rounding, from a program of a quarter of the size


def trained_by_jax(field, x0, u, dt=DT):
    return integrate(lambda x, u: as_field(field).train_batch(x, u), x0, u, dt, LOOP)


def both_ways(function, field, x0, u, d_states):
    arrays, rest = eqx.partition(field, eqx.is_array)
    states, pullback = jax.vjp(lambda arrays, x0: function(eqx.combine(arrays, rest), x0, u), arrays, x0)
    return states, pullback(d_states)


def doubled(tree):
    return jax.tree.map(lambda leaf: np.asarray(leaf, float) if eqx.is_inexact_array(leaf) else leaf, tree)


def calls(function, *arguments):
    return "custom_call @hybrid_jax_" in eqx.filter_jit(function).lower(*arguments).as_text()


@needs_kernels
@pytest.mark.parametrize("name", FIELDS)
def test_values_and_derivatives_are_those_of_jax_in_double_precision(name):
    field = FIELDS[name]()
    arguments = windows(field, 33, steps=2)
    assert calls(trained, field, *arguments[:2])
    found = eqx.filter_jit(partial(both_ways, trained))(field, *arguments)
    with jax.enable_x64(True):
        exact = eqx.filter_jit(partial(both_ways, trained_by_jax))(*doubled((field, *arguments)))
        for one, other in zip(jax.tree.leaves(found), jax.tree.leaves(exact), strict=True):
            # Twelve evaluations of sums of up to a hundred terms, each rounded at 6e-8. Those of θ_p cancel in part.
            tolerance = 5e-6 if other.ndim else 5e-5
            np.testing.assert_allclose(one, other, rtol=0, atol=tolerance * np.abs(other).max(initial=0) + 1e-30)


@needs_kernels
def test_a_lane_is_the_same_alone_to_the_bit_and_inputs_have_the_derivative_of_jax():
    lanes = windows(paper(), 20, lanes=(2, 3))
    function = partial(both_ways, trained, paper())
    together = jax.jit(jax.vmap(jax.vmap(function)))(*lanes)
    single = jax.jit(function)(*(part[1, 2] for part in lanes))
    for one, other in zip(jax.tree.leaves(together), jax.tree.leaves(single), strict=True):
        np.testing.assert_array_equal(one[1, 2], other)
    x0, u, d_states = windows(paper(), 16)
    slopes = [jax.vjp(partial(of, paper(), x0), u)[1](d_states)[0] for of in (trained, trained_by_jax)]
    np.testing.assert_allclose(*slopes, rtol=0, atol=1e-5 * np.abs(slopes[1]).max())


class Own(RigidBody):
    def train_batch(self, x, u):
        return 2 * super().train_batch(x, u)


OTHERS = {
    "physics of one's own": lambda: (Hybrid(Own(THETA, IRIS), paper().residual), 16),
    "few windows": lambda: (paper(), 9),
}


@needs_kernels
def test_the_reason_is_told_why_a_field_has_no_kernel():
    def sorting(x, u):
        return jnp.sort(x)

    assert not calls(predict, sorting, jnp.ones((16, 3)), jnp.ones((16, 2, 1)), DT)
    assert "sorting: its operation 'sort'" in kernels.status()


@pytest.mark.parametrize("name", ["the paper's", *OTHERS])
def test_others_are_plain_jax_and_fusion_emitters_are_spared_where_kernels_serve(name):
    field, b = OTHERS.get(name, lambda: (paper(), 16))()
    served = name not in OTHERS and library.obstacle() is None
    assert calls(trained, field, *windows(paper(), b)[:2]) == served
    x0, u, states = (np.moveaxis(part, -1, 0) for part in windows(paper(), 40))
    found = compiler_options(field, Trajectories(x0, u, states, DT), Settings(batch_size=b))
    assert found == (FAST_COMPILE if served else {})


@pytest.mark.parametrize("solver", [RK4(substeps=2), RK4(scanned=True)])
def test_only_one_step_of_rk4_an_interval_is_a_kernel(solver):
    x0, u, _ = windows(paper(), 16)
    found = calls(lambda field, x0, u: rollout_minibatch(field, x0, u, DT, solver), paper(), x0, u)
    assert found == (solver.substeps == 1 and (library.obstacle() is None))


@needs_kernels
@pytest.mark.parametrize("name", FIELDS)
def test_windows_are_predicted_as_by_jax_in_double_precision(name):
    field = FIELDS[name]()
    x0, u, _ = windows(field, 150, steps=5)  # no multiple of a vector
    x0, u = x0.T, np.moveaxis(u, -1, 0)
    assert calls(predict, field, x0, u, DT)
    found = eqx.filter_jit(predict)(field, x0, u, DT)
    with jax.enable_x64(True):
        exact = rollout_batch(*doubled((field, x0, u)), DT, LOOP)
    np.testing.assert_allclose(found, exact, rtol=0, atol=5e-6 * np.abs(exact).max())


@needs_kernels
def test_a_prediction_has_the_derivative_of_jax():
    field = FIELDS["a force and a torque"]()
    x0, u, _ = windows(field, 16)
    x0, u = x0.T, np.moveaxis(u, -1, 0)

    def slopes(predict):
        arrays, rest = eqx.partition(field, eqx.is_array)
        return jax.grad(lambda arrays: jnp.sum(jnp.square(predict(eqx.combine(arrays, rest), x0, u, DT))))(arrays)

    by_jax = partial(rollout_batch, solver=LOOP)
    for one, other in zip(*map(jax.tree.leaves, (slopes(predict), slopes(by_jax))), strict=True):
        np.testing.assert_allclose(one, other, rtol=0, atol=1e-5 * np.abs(other).max())


STATES, INPUTS, WEIGHTS, DEPTH = 12, 2, 6, 4
ONE = {
    **{name: getattr(jnp, name) for name in ("sin", "cos", "tanh", "arctan", "arcsinh", "abs", "square")},
    **{name: getattr(jax.nn, name) for name in ("sigmoid", "relu", "softplus")},
    **{name: getattr(jax.scipy.special, name) for name in ("erf", "erfc")},
    **{f"{of.__name__} of a sine": lambda a, of=of: of(0.9 * jnp.sin(a)) for of in
       (jnp.exp, jnp.exp2, jnp.expm1, jnp.sinh, jnp.cosh, jnp.tan, jnp.arcsin, jnp.arccos, jnp.arctanh)},
    **{f"{of.__name__} of a square": lambda a, of=of: of(2 + a * a) for of in
       (jnp.log, jnp.log1p, jnp.sqrt, jnp.cbrt, jnp.arccosh)},
    "rsqrt": lambda a: jax.lax.rsqrt(2 + a * a), "inverse": lambda a: (2 + a * a) ** -2,
    "cube": lambda a: a**3 / 9, "fifth": lambda a: jnp.sin(a) ** 5, "clip": lambda a: jnp.clip(a, -0.5, 0.7),
    "sign": lambda a: a * jnp.sign(a - 0.3), "floor": lambda a: a * jnp.floor(a / 2),
}  # fmt: skip
TWO = {
    "add": jnp.add, "mul": lambda a, b: a * jnp.tanh(b), "sub": jnp.subtract, "div": lambda a, b: a / (1 + b * b),
    "max": jnp.maximum, "min": jnp.minimum, "where": lambda a, b: jnp.where(a > b, a, 2 * b),
    "logical": lambda a, b: jnp.where((a > 0) & (b <= 0.5) | ~(a < b), a, b),
    "rem": lambda a, b: jax.lax.rem(a, 3 + b * b), "atan2": lambda a, b: jnp.arctan2(a, 2 + b * b),
    "pow": lambda a, b: (1 + a * a) ** jnp.tanh(b),
}  # fmt: skip


class Random(AbstractVectorField):
    """Each entry of ẋ is a random expression of weights and of entries of x and u; a layer mixes them."""

    weights: Float[Array, " p"]
    matrix: Float[Array, "d d"]
    seed: int = eqx.field(static=True)

    def __call__(self, x, u):
        rng = np.random.default_rng(self.seed)
        leaves = [*self.weights, *x, *u, 0.5]

        def expression(depth):
            if depth == 0:
                return leaves[rng.integers(len(leaves))]
            if rng.random() < 0.5:
                return ONE[str(rng.choice(list(ONE)))](expression(depth - 1))
            return TWO[str(rng.choice(list(TWO)))](expression(depth - 1), expression(rng.integers(depth)))

        drift = jnp.stack([jnp.asarray(expression(DEPTH), x.dtype) for _ in range(STATES)])
        return jnp.tanh(drift) - 0.1 * self.matrix @ jnp.sin(x)


@needs_kernels
@pytest.mark.parametrize("seed", [*range(3), *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(3, 100))])
def test_a_hundred_random_fields_are_those_of_jax(seed):
    rng = np.random.default_rng(100 + seed)

    def draw(*shape):
        return rng.normal(size=shape).astype(np.float32)

    field = Random(jnp.asarray(draw(WEIGHTS)), jnp.asarray(draw(STATES, STATES)), seed)
    arguments = draw(STATES, 21), draw(2, INPUTS, 21), draw(2, STATES, 21)
    arguments[0][3, 4] = np.nan
    assert calls(trained, field, *arguments[:2]), kernels.status()

    def both(of, *arguments):
        found = eqx.filter_jit(partial(both_ways, partial(of, dt=0.05)))(*arguments)
        return [np.asarray(one) for one in jax.tree.leaves(found)]

    with jax.enable_x64(True):
        exact = both(trained_by_jax, *doubled((field, *arguments)))

    def errors(found):
        """The largest of each array, over its largest number; NaN is where double precision has it."""
        for one, other in zip(found, exact, strict=True):
            np.testing.assert_array_equal(np.isnan(one), np.isnan(other))
            yield np.nanmax(np.abs(one - other), initial=0) / (np.nanmax(np.abs(other), initial=0) or 1)

    own = np.array([*errors(both(trained, field, *arguments))])
    if own.max() > 2e-6:  # where a sum cancels, JAX in single precision is as far off
        assert (own <= np.maximum(2e-6, 2 * np.array([*errors(both(trained_by_jax, field, *arguments))]))).all()
