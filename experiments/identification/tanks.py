"""Cascaded tanks, with one of two levels measured: python -m experiments.identification.tanks --help

Physics: water leaves each tank through a hole, and over its edge when it is full (Schoukens, Mattsson, Wigren, Noël,
Cascaded tanks benchmark combining soft and hard nonlinearities, 2016). After each reversal the measured level stays
where it is before it follows: the sensor has play. The record is on nonlinearbenchmark.org.
"""

import jax
import jax.numpy as jnp

import hybrid_jax as hj
from experiments.identification.record import Benchmark, main

FULL, HALF = 10.0, 5.0  # V, at which the sensor saturates, and at half of it
EDGE, LEVEL = 0.03, 0.02  # widths of smooth corners [V]
WEIR = 0.1


def _positive(x, width):
    return width * jax.nn.softplus(x / width)


class Tanks(hj.AbstractVectorField):
    """x = [upper level, lower level, lower level minus reading], u = [pump], all in V; without play two states.

    Attributes:
        log_flow: ln of the flows out of the upper tank, out of the lower tank, and of the pump (3,).
        log_ratio: ln of the ratio of upper to lower cross-section.
        power: of the level in the flow out of each tank, 0.5 by Torricelli (2,).
        offset: of the hole below the sensor's zero [V] (2,).
        edge: of each tank [V] (2,).
        log_weir: ln of the flow over each edge, per V (2,).
        caught: the share of it that the lower tank catches, as a logit.
        log_play: ln of half the play of the sensor [V]; None without play.
        shape: how the cross-section of the upper tank changes with its level, linear and square (2,); None if constant.
    """

    log_flow: jax.Array
    log_ratio: jax.Array
    power: jax.Array
    offset: jax.Array
    edge: jax.Array
    log_weir: jax.Array
    caught: jax.Array
    log_play: jax.Array | None = None
    shape: jax.Array | None = None

    def __call__(self, x, u):
        upper, lower, pump = jnp.exp(self.log_flow)
        over = [jnp.exp(w) * _positive(x[i] - self.edge[i], WEIR) for i, w in enumerate(self.log_weir)]
        height = [_positive(x[i] + self.offset[i], LEVEL) + 1e-6 for i in range(2)]
        out = [upper * height[0] ** self.power[0], lower * height[1] ** self.power[1]]
        falls = jnp.exp(self.log_ratio) * (out[0] + jax.nn.sigmoid(self.caught) * over[0])
        flows = jnp.stack([pump * u[0] - out[0] - over[0], falls - out[1] - over[1]])
        if self.shape is not None:
            wide = 1 + self.shape @ jnp.stack([x[0] / HALF - 1, (x[0] / HALF - 1) ** 2])
            flows = flows.at[0].divide(wide)
        if self.log_play is None:
            return flows
        # Without slip the difference changes as the level does; at the end of the play it stays (Bouc and Wen).
        slip = jnp.where(flows[1] * x[2] > 0, jnp.minimum((x[2] / jnp.exp(self.log_play)) ** 4, 4.0), 0.0)
        return jnp.append(flows, flows[1] * (1 - slip))


def physics(*extra: str) -> Tanks:
    """Tanks with "log_play", "shape" or both."""
    flow, half = jnp.log(jnp.array([0.05, 0.05, 0.04])), jnp.full(2, 0.5)
    more = {name: start for name, start in {"log_play": jnp.log(0.15), "shape": jnp.zeros(2)}.items() if name in extra}
    edge = jnp.array([9.0, 10.0])
    return Tanks(flow, jnp.zeros(()), half, jnp.full(2, 0.1), edge, jnp.log(half * 0.4), jnp.zeros(()), **more)


def level(x, u):
    """The sensor of the lower tank has play and saturates."""
    return FULL - _positive(FULL - x[1] + jnp.sum(x[2:]), EDGE)


NEAR = {"offset": 0.3, "edge": 0.7, "log_weir": 0.7, "caught": 1.5, "power": 0.1, "log_play": 0.7, "shape": 0.2}


def candidate(*extra: str):
    field, d = physics(*extra), 2 + ("log_play" in extra)
    prior = {name: value for name, value in NEAR.items() if getattr(field, name) is not None}
    start, spread = (4.0, 5.2, 0.0), (5.0, 0.3, 0.3)
    return hj.StateSpaceModel(field, ("u",), {"y": level}, start[:d], spread[:d], noise={"y": 0.2}), prior


BENCHMARK = Benchmark(
    title="Cascaded tanks",
    columns=("u", "y"),
    unit=("V", 1.0),
    candidates={
        "physics": candidate,
        "the sensor has play": lambda: candidate("log_play"),
        "play, walls that are not straight": lambda: candidate("log_play", "shape"),
    },
    options={"dt": 4.0, "substeps": 6, "rounds": 1, "max_steps": 200, "starts": 3},
    # The hidden states at the start are the same in both records.
    start=lambda u, y, model: (model.start[0], y + sum(model.start[2:]), *model.start[2:]),
)

if __name__ == "__main__":
    main(BENCHMARK, "identification.tanks")
