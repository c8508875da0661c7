"""Cascaded tanks, with one of two levels measured: python -m experiments.identification.tanks --help

Physics: water leaves each tank through a hole, and over its edge when it is full (Schoukens, Mattsson, Wigren, Noël,
Cascaded tanks benchmark combining soft and hard nonlinearities, 2016). After each reversal the measured level stays
where it is before it follows: the sensor has play. Above 4.2 V it rises about twice as fast: the sensor has two slopes.
The record is on nonlinearbenchmark.org.
"""

import equinox as eqx
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
    """

    log_flow: jax.Array
    log_ratio: jax.Array
    power: jax.Array
    offset: jax.Array
    edge: jax.Array
    log_weir: jax.Array
    caught: jax.Array
    log_play: jax.Array | None = None

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


class Sensor(eqx.Module):
    """The level that is read [V]: a line that may have a bend, up to where the sensor saturates.

    Attributes:
        bend: the reading at which the slope changes [V], and ln of the ratio of slopes (2,); None if there is none.
    """

    bend: jax.Array | None = None

    def __call__(self, x, u):
        seen = x[1] - jnp.sum(x[2:])
        if self.bend is not None:
            seen = seen + jnp.expm1(self.bend[1]) * _positive(seen - self.bend[0], EDGE)
        return FULL - _positive(FULL - seen, EDGE)


NEAR = {"offset[0]": 0.3, "offset[1]": 1.0, "edge": 0.5, "log_weir": 0.7, "caught": 1.5, "power": 0.03}
WITH = {"play": {"log_play": 0.7}, "bend": {"y.bend[0]": 0.2, "y.bend[1]": 0.5}}


def physics(play: bool = False, edge: float = 10.0) -> Tanks:
    flow, half = jnp.log(jnp.array([0.05, 0.05, 0.04])), jnp.full(2, 0.5)
    own = jnp.full(2, 0.1), jnp.array([9.0, edge]), jnp.log(half * 0.4), jnp.zeros(())
    return Tanks(flow, jnp.zeros(()), half, *own, jnp.log(jnp.array(0.15)) if play else None)


def candidate(*extra: str):
    """The model and priors of physics with "play", "bend", or both."""
    field, d = physics("play" in extra, 7.2 if "bend" in extra else 10.0), 2 + ("play" in extra)
    y = Sensor(jnp.array([4.3, 0.5]) if "bend" in extra else None)
    start, spread = (4.0, 5.2, 0.0), (5.0, 0.3, 0.3)
    prior = {name: size for each in (NEAR, *(WITH[name] for name in extra)) for name, size in each.items()}
    return hj.StateSpaceModel(field, ("u",), {"y": y}, start[:d], spread[:d], noise={"y": 0.2}), prior


def begun(u: float, y: float, model: hj.StateSpaceModel) -> tuple[float, ...]:
    """The hidden states at the start are the same in both records, and the lower level is that of the first reading."""
    bend = model.outputs["y"].bend  # pyright: ignore[reportFunctionMemberAccess]
    below = y if bend is None else min(y, bend[0] + (y - bend[0]) / jnp.exp(bend[1]))
    return model.start[0], float(below) + sum(model.start[2:]), *model.start[2:]


BENCHMARK = Benchmark(
    title="Cascaded tanks",
    columns=("u", "y"),
    unit=("V", 1.0),
    candidates={
        "physics": candidate,
        "the sensor has two slopes": lambda: candidate("bend"),
        "two slopes and play": lambda: candidate("bend", "play"),
    },
    ranges=((5.0, 5.0), (5.0, 5.0), (0.0, 0.3), (2.5, 2.5)),
    sizes={0: 1e-4, 1: 1e-4},
    options={"dt": 4.0, "substeps": 6, "rounds": 1, "max_steps": 200, "starts": 3},
    start=begun,
)

if __name__ == "__main__":
    main(BENCHMARK, "identification.tanks")
