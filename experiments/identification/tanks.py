"""Cascaded tanks, with one of two levels measured: python -m experiments.identification.tanks --help

Physics: water leaves each tank through a hole, and over its edge when it is full (Schoukens, Mattsson, Wigren and Noël,
Cascaded tanks benchmark combining soft and hard nonlinearities, 2016). The record is on nonlinearbenchmark.org.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import hybrid_jax as hj
from experiments.identification.record import Benchmark, main
from hybrid_jax.networks.mlp import ResidualNetwork, residual_network
from hybrid_jax.networks.normalisation import ChannelScaling

FULL, HALF = 10.0, 5.0  # V, at which the sensor saturates, and at half of it
EDGE, LEVEL = 0.03, 0.02  # widths of smooth corners [V]
WEIR = 0.1
MIDDLE, SIZE = np.array([6.0, 6.0, 3.0]), np.array([2.5, 2.5, 1.0])  # of levels and pump [V]
RATE = 0.02  # V/s, the size of what the residual adds


def _positive(x, width):
    return width * jax.nn.softplus(x / width)


class Tanks(hj.AbstractVectorField):
    """x = [upper level, lower level], u = [pump], all in V.

    Attributes:
        log_flow: ln of the flows out of the upper tank, out of the lower tank, and of the pump (3,).
        log_ratio: ln of the ratio of upper to lower cross-section.
        power: of the level in the flow out of each tank, 0.5 by Torricelli (2,).
        offset: of the hole below the sensor's zero [V] (2,).
        edge: of each tank [V] (2,).
        log_weir: ln of the flow over each edge, per V (2,).
        caught: the share of it that the lower tank catches, as a logit.
        shape: how the cross-section of each tank changes with its level, linear and square (2, 2); None if constant.
    """

    log_flow: jax.Array
    log_ratio: jax.Array
    power: jax.Array
    offset: jax.Array
    edge: jax.Array
    log_weir: jax.Array
    caught: jax.Array
    shape: jax.Array | None = None

    def __call__(self, x, u):
        upper, lower, pump = jnp.exp(self.log_flow)
        over = [jnp.exp(w) * _positive(x[i] - self.edge[i], WEIR) for i, w in enumerate(self.log_weir)]
        height = [_positive(x[i] + self.offset[i], LEVEL) + 1e-6 for i in range(2)]
        out = [upper * height[0] ** self.power[0], lower * height[1] ** self.power[1]]
        falls = jnp.exp(self.log_ratio) * (out[0] + jax.nn.sigmoid(self.caught) * over[0])
        flows = jnp.stack([pump * u[0] - out[0] - over[0], falls - out[1] - over[1]])
        if self.shape is None:
            return flows
        height = x / HALF - 1
        return flows / (1 + self.shape[:, 0] * height + self.shape[:, 1] * height**2)


def residual(hidden: int) -> ResidualNetwork:
    """One hidden layer of tanh units of levels and pump, zero at the start."""
    scaling = ChannelScaling(tuple(MIDDLE.tolist()), tuple(SIZE.tolist()), (RATE, RATE))
    made = residual_network(2, 1, jax.random.key(0), hidden=hidden, scaling=scaling, norm="none", activation="tanh")
    return eqx.tree_at(lambda made: (made.weight_out, made.bias_out), made, (jnp.zeros((2, hidden)), jnp.zeros(2)))


def physics(shaped: bool = False) -> Tanks:
    flow, half = jnp.log(jnp.array([0.05, 0.05, 0.04])), jnp.full(2, 0.5)
    edge = jnp.array([9.0, 10.0])
    shape = jnp.zeros((2, 2)) if shaped else None
    return Tanks(flow, jnp.zeros(()), half, jnp.full(2, 0.1), edge, jnp.log(half * 0.4), jnp.zeros(()), shape)


def level(x, u):
    """The sensor of the lower tank saturates."""
    return FULL - _positive(FULL - x[1], EDGE)


def model(field) -> hj.StateSpaceModel:
    return hj.StateSpaceModel(field, ("u",), {"y": level}, start=(4.0, 5.2), spread=(5.0, 0.3))


NEAR = {"offset": 0.3, "edge": 0.7, "log_weir": 0.7, "caught": 1.5, "power": 0.1}


def white(shaped: bool):
    near = NEAR | ({"shape": 0.2} if shaped else {})
    return model(physics(shaped)), {f"field.{name}": value for name, value in near.items()}


def hybrid(size: float = 0.1, hidden: int = 6):
    """Return physics with a residual whose outer weights have about this size."""
    prior = {f"field.physics.{name}": value for name, value in NEAR.items()}
    prior |= {"field.residual": 0.7, "field.residual.weight_out": size, "field.residual.bias_out": size}
    return model(hj.Hybrid(physics(), residual(hidden))), prior


BENCHMARK = Benchmark(
    title="Cascaded tanks",
    columns=("u", "y"),
    unit=("V", 1.0),
    candidates={
        "physics, straight walls": lambda: white(False),
        "physics, walls that are not straight": lambda: white(True),
        "physics and a residual": hybrid,
    },
    options={"dt": 4.0, "substeps": 2, "rounds": 1, "max_steps": 60, "noise": {"y": 0.2}},
    # The upper level at the start is the same in both records.
    start=lambda y, fitted: (fitted.start[0], y),
    hidden=(5.0, 0.3),
)

if __name__ == "__main__":
    main(BENCHMARK, "identification.tanks")
