"""Random fields of operations that kernels know have the values and the derivatives that JAX gives them."""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array, Float
from test_rollouts import both_ways, calls, doubled, needs_kernels, trained, trained_by_jax

from hybrid_jax import AbstractVectorField, kernels

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
