"""The equations, on a periodic grid, and their trajectories.

FitzHugh–Nagumo as in APHYNITY (Yin, Le Guen, Dona et al., ICLR 2021): u, v uniform in [0, 1] at every point of 32 × 32
points on [−1, 1]². Gray–Scott as in Neural Context Flows (Nzoyem, Barton, Deakin, ICLR 2025): three squares of u = 0,
v = 1 in u = 0.95, v = 0.05, 32 × 32 points at distance 1.
"""

from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import hybrid_jax as hj
from hybrid_jax.dynamics.base import as_field
from hybrid_jax.networks.grids import GridNetwork

A, B, K = 1e-3, 5e-3, 5e-3
DT, STEPS = 0.1, 25
FINE = hj.RK4(substeps=20)  # of the generator; halving its step changes states by 1e-7
COARSE = hj.RK4(substeps=2)  # of models: an error of 1e-10 in the mean square, where published models reach 1e-5
D_U, D_V = 0.2097, 0.105
SCOTT_DT, SCOTT_STEPS = 40.0, 9
SCOTT_FINE, SCOTT_COARSE = hj.RK4(substeps=80), hj.RK4(substeps=40)


class FitzHughNagumo(hj.AbstractVectorField):
    """u_t = aΔu + u − u³ − k − v + c u v, v_t = bΔv + u − v; c = 0 but for a term that the source never had."""

    accepts_batch: ClassVar[bool] = True

    log_diffusivity: Float[Array, "2"]
    k: Float[Array, ""]
    coupling: float = eqx.field(static=True)
    grid: hj.Grid = eqx.field(static=True)

    def __call__(self, x, u):
        fields = self.grid.fields(x)
        activator, inhibitor = fields
        coupled = self.coupling * activator * inhibitor
        reaction = jnp.stack([activator - activator**3 - self.k - inhibitor + coupled, activator - inhibitor])
        return hj.Diffusion(self.log_diffusivity, self.grid)(x, u) + reaction.reshape(x.shape)

    def theta(self) -> dict[str, Array]:
        return {"diffusivity": jnp.exp(self.log_diffusivity), "k": self.k}


def fitzhugh_nagumo(grid: hj.Grid, a: float = A, b: float = B, k: float = K, coupling: float = 0.0) -> FitzHughNagumo:
    return FitzHughNagumo(jnp.log(jnp.array([a, b])), jnp.asarray(k), coupling, grid)


def plane(points: int) -> hj.Grid:
    return hj.Grid((points, points), 2 / points, 2)


def trajectories(field, x0: Float[np.ndarray, "n d"], dt: float, steps: int, solver, inputs=None) -> hj.Trajectories:
    """Simulate a field from each x0, a few trajectories at a time, without inputs or with the same in all."""
    u = np.zeros((len(x0), steps, 0), np.float32) if inputs is None else np.tile(inputs, (len(x0), steps, 1))

    @eqx.filter_jit
    def run(field, x0, u):
        one = lambda pair: hj.rollout(field, pair[0], pair[1], dt, solver)  # noqa: E731
        return jax.lax.map(one, (x0, u), batch_size=8)

    return hj.Trajectories(x0, u, np.asarray(run(field, jnp.asarray(x0), jnp.asarray(u))), dt)


def reacting(field: FitzHughNagumo, count: int, seed: tuple[int, ...], noise: float = 0.0) -> hj.Trajectories:
    """Simulate `count` trajectories of 2.5 s, with white noise on all states, the first too."""
    rng = np.random.default_rng(seed)
    x0 = rng.random((count, field.grid.size)).astype(np.float32)
    found = trajectories(field, x0, DT, STEPS, FINE)
    noisy = (part + noise * rng.normal(size=part.shape).astype(np.float32) for part in (found.x0, found.x))
    x0, x = noisy if noise else (found.x0, found.x)
    return hj.Trajectories(x0, found.u, x, DT)


class GrayScott(hj.AbstractVectorField):
    """u_t = D_u Δu + F (1 − u), v_t = D_v Δv − (F + k) v, and with `reacts` the reaction ∓ u v².

    The environment is the input, a one-hot vector: row e of `rates` holds log F and log k there.
    """

    accepts_batch: ClassVar[bool] = True

    rates: Float[Array, "e 2"]
    reacts: bool = eqx.field(static=True)
    grid: hj.Grid = eqx.field(static=True)

    def __call__(self, x, u):
        fields = self.grid.fields(x)
        substrate, catalyst = fields
        feed, kill = jnp.exp(jnp.tensordot(self.rates.T, u, 1))
        spread = self.grid.laplacian(fields)
        reaction = self.reacts * substrate * catalyst**2
        first = D_U * spread[0] + feed * (1 - substrate) - reaction
        second = D_V * spread[1] - (feed + kill) * catalyst + reaction
        return jnp.stack([first, second]).reshape(x.shape)

    def linearize(self, x, u, dx, du):
        # As a batch: `jax.vmap` over the last axis takes twice the time.
        many = (jnp.broadcast_to(part[:, None], columns.shape) for part, columns in ((x, dx), (u, du)))
        return self(x, u), jax.jvp(self, (*many,), (dx, du))[1]

    def theta(self) -> dict[str, Array]:
        return {"F": jnp.exp(self.rates[:, 0]), "k": jnp.exp(self.rates[:, 1])}


class Conversion(hj.AbstractVectorField):
    """At each point v gains what u loses: ẋ = (−r, r), with a network for the rate r(u, v) of the reaction."""

    accepts_batch: ClassVar[bool] = True

    rate: GridNetwork  # of one output

    def __call__(self, x, u):
        return self.both(self.rate(x, u))

    def both(self, rate: Float[Array, " n *b"]) -> Float[Array, " d *b"]:
        return jnp.concatenate([-rate, rate])

    def linearize(self, x, u, dx, du):
        rate, columns = as_field(self.rate).linearize(x, u, dx, du)
        return self.both(rate), self.both(columns)

    def parameter_columns(self, x, u):
        return self.both(as_field(self.rate).parameter_columns(x, u))


def gray_scott(environments, reacts: bool, points: int = 32) -> GrayScott:
    return GrayScott(jnp.log(jnp.asarray(environments)), reacts, hj.Grid((points, points), 1.0, 2))


def patterns(field: GrayScott, environment: int, count: int, seed: tuple[int, ...]) -> hj.Trajectories:
    """Simulate `count` trajectories of an environment from t = 0 to 360 s, sampled every 40 s."""
    rng, points = np.random.default_rng(seed), field.grid.shape[0]
    x0 = np.tile(np.array([0.95, 0.05], np.float32)[:, None, None], (count, 1, points, points))
    side = max(points // 10, 1)
    for fields in x0:
        for row, column in rng.integers(0, points - side, (3, 2)):
            fields[:, row : row + side, column : column + side] = np.array([0, 1], np.float32)[:, None, None]
    inputs = np.eye(len(field.rates), dtype=np.float32)[environment]
    return trajectories(field, x0.reshape(count, -1), SCOTT_DT, SCOTT_STEPS, SCOTT_FINE, inputs)
