"""Electro-mechanical positioning with only position measured: python -m experiments.identification.emps --help

Physics: a mass with viscous and Coulomb friction and an offset (Janot, Gautier and Brunot, Data set and reference
models of EMPS, 2019). The offset may drift as the drive warms up from the start of a record, the force may lag, and
friction may depend on the position along the guide.
The record is on nonlinearbenchmark.org.
"""

import jax
import jax.numpy as jnp

import hybrid_jax as hj
from experiments.identification.record import Benchmark, main

STICK = 1.5e-3  # m/s, below which Coulomb friction falls to zero
MIDDLE = 0.12  # m, of the stroke
FORCE = 50.0  # N, at which the drive's temperature settles at 1


class Slide(hj.AbstractVectorField):
    """x = [position, velocity, temperature of the drive], u = [force]; without a drift two states.

    Attributes:
        log_mass: ln of the mass [kg].
        log_viscous: ln of the viscous friction [N s/m].
        log_coulomb: ln of the Coulomb friction [N].
        offset: of the force [N], and its change when the drive is warm if it drifts (1 or 2).
        direction: relative difference of the viscous friction in the two directions; None if equal.
        log_warming: ln of the time in which the drive warms up [s]; None without a drift.
        place: what the end of the stroke adds to the offset and to the Coulomb friction [N], and its beginning takes
            from them (2,); None if the guide is uniform.
    """

    log_mass: jax.Array
    log_viscous: jax.Array
    log_coulomb: jax.Array
    offset: jax.Array
    direction: jax.Array | None
    log_warming: jax.Array | None
    place: jax.Array | None

    def __call__(self, x, u):
        coulomb, viscous = jnp.exp(self.log_coulomb), jnp.exp(self.log_viscous)
        way = jnp.tanh(x[1] / STICK)
        if self.direction is not None:
            viscous = viscous * (1 + self.direction * way)
        offset = self.offset[0] + self.offset[1:] @ x[2:]
        if self.place is not None:
            offset = offset + (x[0] / MIDDLE - 1) * self.place @ jnp.stack([jnp.ones(()), way])
        motion = [x[1], (u[0] - viscous * x[1] - coulomb * way - offset) / jnp.exp(self.log_mass)]
        if self.log_warming is not None:
            motion.append(((u[0] / FORCE) ** 2 - x[2]) / jnp.exp(self.log_warming))
        return jnp.stack(motion)


def position(x, u):
    return x[0]


def candidate(direction: bool = False, drift: bool = False, lag: bool = False, place: bool = False):
    mass, viscous, coulomb = (jnp.array(number) for number in (4.55, 5.3, 3.0))
    offset, turned = jnp.array([-3.0, 0.0][: 1 + drift]), jnp.zeros(()) if direction else None
    varied = jnp.zeros(2) if place else None
    field = Slide(mass, viscous, coulomb, offset, turned, jnp.log(20.0) if drift else None, varied)
    prior = {"direction": 0.3} if direction else {}
    prior |= ({"log_warming": 1.0} if drift else {}) | ({"place": 2.0} if place else {})
    if lag:
        field = hj.with_hidden(field, hj.dynamics.Lag(jnp.log(jnp.array([0.01])), places=(0,)))
        prior = {f"field.{name}": value for name, value in prior.items()} | {"parts": 1.0}
    d, spread = 2 + drift, (1e-5, 1e-6, 0.0)[: 2 + drift] + (1.0,) * lag
    start = (0.0,) * (d + lag)
    return hj.StateSpaceModel(field, ("u",), {"q": position}, start, spread, noise={"q": 3e-3}), prior


BENCHMARK = Benchmark(
    title="EMPS",
    columns=("u", "q"),
    unit=("mm", 1e3),
    candidates={
        "physics": candidate,
        "friction depends on direction": lambda: candidate(True),
        "direction, and an offset that drifts": lambda: candidate(True, True),
        "direction, drift, and a force that lags": lambda: candidate(True, True, True),
        "and a guide that is not uniform": lambda: candidate(True, True, True, True),
    },
    ranges=((MIDDLE, MIDDLE), (0.0, 0.1), (0.5, 0.5), (0.0, FORCE), (0.0, FORCE)),
    sizes={1: 0.001},
    options={"dt": 0.01, "substeps": 16, "between": "linear", "rounds": 1, "max_steps": 200},
    # At rest and cold; the force has acted for longer than its lag.
    start=lambda u, q, model: (q, 0.0, 0.0, u)[: len(model.start)],
    parts=3,
)

if __name__ == "__main__":
    main(BENCHMARK, "identification.emps")
