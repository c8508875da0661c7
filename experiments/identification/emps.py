"""Electro-mechanical positioning with only position measured: python -m experiments.identification.emps --help

Physics: a mass with viscous and Coulomb friction and an offset (Janot, Gautier and Brunot, Data set and reference
models of EMPS, 2019). The record is on nonlinearbenchmark.org.
"""

import jax
import jax.numpy as jnp

import hybrid_jax as hj
from experiments.identification.record import Benchmark, main

STICK = 1.5e-3  # m/s, below which Coulomb friction falls to zero
SPEED = 0.1  # m/s


class Slide(hj.AbstractVectorField):
    """x = [position, velocity], u = [force].

    Attributes:
        log_mass: ln of the mass [kg].
        log_viscous: ln of the viscous friction at 0.1 m/s [N s/m].
        log_coulomb: ln of the Coulomb friction [N].
        offset: of the force [N].
        power: exponent of the velocity in the viscous friction, beyond 1; None if it is linear.
        direction: relative difference of the viscous friction in the two directions; None if equal.
    """

    log_mass: jax.Array
    log_viscous: jax.Array
    log_coulomb: jax.Array
    offset: jax.Array
    power: jax.Array | None
    direction: jax.Array | None

    def __call__(self, x, u):
        coulomb, viscous = jnp.exp(self.log_coulomb), jnp.exp(self.log_viscous)
        if self.power is not None:
            viscous = viscous * (jnp.abs(x[1]) / SPEED + 0.01) ** self.power
        way = jnp.tanh(x[1] / STICK)
        if self.direction is not None:
            viscous = viscous * (1 + self.direction * way)
        force = u[0] - viscous * x[1] - coulomb * way - self.offset
        return jnp.stack([x[1], force / jnp.exp(self.log_mass)])


def candidate(*extra: str):
    """Return a slide whose viscous friction may depend on direction and on a power of the velocity."""
    mass, viscous, coulomb, offset = (jnp.array(number) for number in (4.55, 5.3, 3.0, -3.0))
    more = {name: jnp.zeros(()) if name in extra else None for name in ("power", "direction")}
    start = Slide(mass, viscous, coulomb, offset, **more)
    model = hj.StateSpaceModel(start, ("u",), {"q": lambda x, u: x[0]}, start=(0.0, 0.0), spread=(1e-5, 1e-6))
    return model, {f"field.{name}": 0.3 for name in extra}


BENCHMARK = Benchmark(
    title="EMPS",
    columns=("u", "q"),
    unit=("mm", 1e3),
    candidates={
        "physics": candidate,
        "friction depends on direction": lambda: candidate("direction"),
        "direction, and not linear in velocity": lambda: candidate("power", "direction"),
    },
    options={"dt": 0.01, "substeps": 2, "between": "linear", "rounds": 1, "max_steps": 40, "noise": {"q": 3e-3}},
    start=lambda q, fitted: (q, 0.0),
    hidden=(1e-4, 0.3),
)

if __name__ == "__main__":
    main(BENCHMARK, "identification.emps")
