"""A system of which not every state is measured: ẋ = f(x, u), y = h(x, u)."""

from collections.abc import Callable, Mapping

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from hybrid_jax.dynamics.base import AbstractVectorField, state_space
from hybrid_jax.state_space import StateSpace

Output = Callable[[Float[Array, " d"], Float[Array, " m"]], Float[Array, "*k"]]


def _numbers(values) -> tuple[float, ...]:
    return tuple(float(each) for each in values)


class StateSpaceModel(eqx.Module):
    """ẋ = f(x, u) with measured outputs y = h(x, u), an initial state that need not be known, and process noise.

    Every array inside the field and the outputs is learned, so an output may be a module with a bias of its own; Python
    numbers are constants.

    Attributes:
        field: f.
        inputs: the names of the signals that make up u, in order.
        outputs: h by name: each a function of the state (d,) and the input (m,) that returns a scalar or (k,).
        start: the initial state that is expected (d,).
        spread: the standard deviation of the initial state about `start` (d,): 0 if it is known, infinite if nothing
            is known of it. Where the field's state space has an attitude, this has three numbers, its rotation [rad].
        process: the standard deviation of what acts on each state at random, per square root of a second, one number
            for each of `spread`; by default 0. A state of which nothing but this noise acts is a random walk.

    Raises:
        ValueError: sizes that do not agree, or a negative deviation.
    """

    field: AbstractVectorField
    inputs: tuple[str, ...] = eqx.field(static=True, converter=tuple)
    outputs: Mapping[str, Output]
    start: tuple[float, ...] = eqx.field(static=True, converter=_numbers)
    spread: tuple[float, ...] = eqx.field(static=True, converter=_numbers)
    process: tuple[float, ...] = eqx.field(static=True, converter=_numbers, default=())

    def __check_init__(self):
        if not self.outputs:
            raise ValueError("outputs: at least one is needed, such as {'angle': lambda x, u: x[0]}")
        expected = self.space.tangent_size
        for name, numbers in (("spread", self.spread), ("process", self.process)):
            if len(numbers) not in ((0, expected) if name == "process" else (expected,)):
                raise ValueError(f"{name} must have {expected} numbers, as a change of start has, got {len(numbers)}")
            for number in numbers:
                if not number >= 0:
                    raise ValueError(f"{name} must not be negative, got {number}")

    @property
    def size(self) -> int:
        """The number of states d."""
        return len(self.start)

    @property
    def space(self) -> StateSpace:
        """What a state is to the field; of states of which it says nothing, each is a quantity of its own."""
        return state_space(self.field, self.size)

    def measure(self, x: Float[Array, " d"], u: Float[Array, " m"]) -> dict[str, Float[Array, " k"]]:
        """What is measured in a state, by name.

        Args:
            x: the state (d,).
            u: the input (m,).
        """
        found = {name: jnp.atleast_1d(jnp.asarray(output(x, u))) for name, output in self.outputs.items()}
        for name, y in found.items():
            if y.ndim != 1:
                raise ValueError(f"outputs: {name} must return a scalar or one axis, got shape {y.shape}")
        return found
