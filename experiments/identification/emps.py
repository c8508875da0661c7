"""An electro-mechanical positioning system, position alone measured: python -m experiments.identification.emps --help

Physics: a mass with viscous and Coulomb friction and an offset (Janot, Gautier and Brunot, Data set and reference
models of EMPS, 2019). The record is on nonlinearbenchmark.org.
"""

import jax
import jax.numpy as jnp

import hybrid_jax as hj
from experiments.identification.record import Benchmark, main

STICK = 1.5e-3  # m/s, below which Coulomb friction falls to zero
MIDDLE, REACH = 0.12, 0.12  # of the position [m]
FORCE = 10.0  # N, the size of what depends on the position
SPEED = 0.1  # m/s


class Slide(hj.AbstractVectorField):
    """x = [position, velocity], u = [force].

    Attributes:
        log_mass: ln of the mass [kg].
        log_viscous: ln of the viscous friction at 0.1 m/s [N s/m].
        log_coulomb: ln of the Coulomb friction in the middle [N].
        offset: of the force [N].
        along: how the Coulomb friction changes along the guide, linear and square, in 10 N (2,); None if it does not.
        power: of the velocity in the viscous friction, beyond 1; None if it is linear.
    """

    log_mass: jax.Array
    log_viscous: jax.Array
    log_coulomb: jax.Array
    offset: jax.Array
    along: jax.Array | None
    power: jax.Array | None

    def __call__(self, x, u):
        coulomb, viscous = jnp.exp(self.log_coulomb), jnp.exp(self.log_viscous)
        if self.along is not None:
            place = (x[0] - MIDDLE) / REACH
            coulomb = coulomb + FORCE * (self.along[0] * place + self.along[1] * place**2)
        if self.power is not None:
            viscous = viscous * (jnp.abs(x[1]) / SPEED + 0.01) ** self.power
        force = u[0] - viscous * x[1] - coulomb * jnp.tanh(x[1] / STICK) - self.offset
        return jnp.stack([x[1], force / jnp.exp(self.log_mass)])


def candidate(along: bool = False, power: bool = False):
    """A slide, whose friction may depend on position and speed."""
    mass, viscous, coulomb, offset = (jnp.array(number) for number in (4.55, 5.3, 3.0, -3.0))
    start = Slide(mass, viscous, coulomb, offset, jnp.zeros(2) if along else None, jnp.zeros(()) if power else None)
    model = hj.StateSpaceModel(start, ("u",), {"q": lambda x, u: x[0]}, start=(0.0, 0.0), spread=(1e-5, 1e-6))
    return model, {f"field.{name}": 0.3 for name, used in (("along", along), ("power", power)) if used}


BENCHMARK = Benchmark(
    title="EMPS",
    columns=("u", "q"),
    unit=("mm", 1e3),
    candidates={
        "physics": candidate,
        "friction changes along the guide": lambda: candidate(along=True),
        "friction is not linear in velocity": lambda: candidate(power=True),
        "both": lambda: candidate(along=True, power=True),
    },
    options={"dt": 0.01, "substeps": 2, "between": "linear", "rounds": 1, "max_steps": 40, "noise": {"q": 3e-3}},
    start=lambda q, fitted: (q, 0.0),
    hidden=(1e-4, 0.3),
)

if __name__ == "__main__":
    main(BENCHMARK, "identification.emps")
