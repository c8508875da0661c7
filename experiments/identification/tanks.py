"""Cascaded tanks, with one of two levels measured: python -m experiments.identification.tanks --help

Physics: water leaves each tank through a hole, and over its edge when it is full (Schoukens, Mattsson, Wigren, Noël,
Cascaded tanks benchmark combining soft and hard nonlinearities, 2016). After each reversal the measured level stays
where it is before it follows: the sensor has play. Above 4.2 V it rises about twice as fast: the sensor has two slopes.
The record is on nonlinearbenchmark.org.
"""

import jax
import jax.numpy as jnp

import hybrid_jax as hj
from experiments.identification.record import Benchmark, main

FULL = 10.0  # V, at which the sensor saturates
EDGE, LEVEL, WEIR = 0.03, 0.02, 0.1  # widths of smooth corners [V]


def _positive(x, width):
    return width * jax.nn.softplus(x / width)


class Tanks(hj.AbstractVectorField):
    """x = [upper level, lower level, lower level minus what the sensor follows], u = [pump], all in V.

    Levels are in volts of the lower sensor near its zero. Without play there are two states.

    Attributes:
        log_flow: ln of the flows out of the upper tank, out of the lower tank, and of the pump (3,).
        log_ratio: ln of the ratio of upper to lower cross-section.
        power: of the level in the flow out of each tank, 0.5 by Torricelli (2,).
        offset: of the hole below the sensor's zero [V] (2,).
        edge: of each tank [V] (2,).
        log_weir: ln of the flow over each edge, per V (2,).
        caught: the share of it that the lower tank catches, as a logit.
        log_play: ln of half the play of the sensor [V]; None without play.
        bend: the reading at which the sensor's slope changes [V], and ln of the ratio of slopes (2,); None if straight.
    """

    log_flow: jax.Array
    log_ratio: jax.Array
    power: jax.Array
    offset: jax.Array
    edge: jax.Array
    log_weir: jax.Array
    caught: jax.Array
    log_play: jax.Array | None = None
    bend: jax.Array | None = None

    def __call__(self, x, u):
        upper, lower, pump = jnp.exp(self.log_flow)
        over = [jnp.exp(w) * _positive(x[i] - self.edge[i], WEIR) for i, w in enumerate(self.log_weir)]
        height = [_positive(x[i] + self.offset[i], LEVEL) + 1e-6 for i in range(2)]
        out = [upper * height[0] ** self.power[0], lower * height[1] ** self.power[1]]
        falls = jnp.exp(self.log_ratio) * (out[0] + jax.nn.sigmoid(self.caught) * over[0])
        flows = jnp.stack([pump * u[0] - out[0] - over[0], falls - out[1] - over[1]])
        if self.log_play is None:
            return flows
        # Without slip the difference changes as the level does; at the end of the play it stays (Bouc and Wen).
        slip = jnp.where(flows[1] * x[2] > 0, jnp.minimum((x[2] / jnp.exp(self.log_play)) ** 4, 1.0), 0.0)
        return jnp.append(flows, flows[1] * (1 - slip))


def physics(*extra: str) -> Tanks:
    """Tanks with "log_play", "bend" or both."""
    flow, half = jnp.log(jnp.array([0.05, 0.05, 0.04])), jnp.full(2, 0.5)
    starts = {"log_play": jnp.log(0.15), "bend": jnp.array([4.3, 0.5])}
    edge = jnp.array([9.0, 7.2 if "bend" in extra else 10.0])
    more = {name: starts[name] for name in extra}
    return Tanks(flow, jnp.zeros(()), half, jnp.full(2, 0.1), edge, jnp.log(half * 0.4), jnp.zeros(()), **more)


def level(x, u, field: Tanks):
    """The sensor of the lower tank has play, two slopes, and saturates."""
    seen = x[1] - jnp.sum(x[2:])
    if field.bend is not None:
        seen = seen + jnp.expm1(field.bend[1]) * _positive(seen - field.bend[0], EDGE)
    return FULL - _positive(FULL - seen, EDGE)


NEAR = {
    "offset[0]": 0.3, "offset[1]": 1.0, "edge": 0.5, "log_weir": 0.7, "caught": 1.5, "power": 0.03, "log_play": 0.7,
    "bend[0]": 0.2, "bend[1]": 0.5,
}  # fmt: skip


def candidate(*extra: str):
    field, d = physics(*extra), 2 + ("log_play" in extra)
    prior = {name: value for name, value in NEAR.items() if getattr(field, name.split("[")[0]) is not None}
    start, spread = (4.0, 5.2, 0.0), (5.0, 0.3, 0.3)
    return hj.StateSpaceModel(field, ("u",), {"y": level}, start[:d], spread[:d], noise={"y": 0.2}), prior


def begun(u: float, y: float, model: hj.StateSpaceModel) -> tuple[float, ...]:
    """The hidden states at the start are the same in both records, and the lower level is that of the first reading."""
    assert isinstance(model.field, Tanks)
    bend = model.field.bend
    below = y if bend is None else min(y, bend[0] + (y - bend[0]) / jnp.exp(bend[1]))
    return model.start[0], float(below) + sum(model.start[2:]), *model.start[2:]


BENCHMARK = Benchmark(
    title="Cascaded tanks",
    columns=("u", "y"),
    unit=("V", 1.0),
    candidates={
        "physics": candidate,
        "the sensor has two slopes": lambda: candidate("bend"),
        "two slopes and play": lambda: candidate("bend", "log_play"),
    },
    options={"dt": 4.0, "substeps": 6, "rounds": 1, "max_steps": 200, "starts": 3},
    start=begun,
)

if __name__ == "__main__":
    main(BENCHMARK, "identification.tanks")
