"""Partially measured systems: ẋ = f(x, u), y = h(x, u)."""

import inspect
from collections import OrderedDict
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hybrid_jax import checks
from hybrid_jax.dynamics.base import AbstractVectorField, state_space
from hybrid_jax.state_space import Angle, Quantity, StateSpace

ANGLE = Angle("angle")
Output = Callable[..., Float[Array, "*k"]]


def _numbers(values) -> tuple[float, ...]:
    return tuple(float(each) for each in values)


def _numbers_by_name(values) -> Mapping[str, tuple[float, ...]]:
    return _ordered({name: _numbers(np.ravel(each)) for name, each in values.items()})


def _ordered(outputs: Any) -> Any:
    return outputs if outputs is None else OrderedDict(outputs)  # JAX sorts the keys of a dict


class Measured(eqx.Module):
    """A quantity of the state as an output, compared in its tangent space."""

    part: tuple[int, int] = eqx.field(static=True)
    quantity: Quantity = eqx.field(static=True)

    def __call__(self, x, u):
        return x[slice(*self.part)]


class StateSpaceModel(eqx.Module):
    """A field ẋ = f(x, u) with measured outputs y = h(x, u), a possibly unknown initial state, and process noise.

    Every array inside the field and the outputs is learned; Python numbers are constants. For example, an output may
    be a module that learns its own bias.

    Attributes:
        field: the vector field f.
        inputs: the names of the signals that make up u, in order.
        outputs: the functions h by name. Each takes the state (d,) and the input (m,), and returns a scalar or (k,). A
            function with a third argument also gets the field, for example for an accelerometer, which measures ẋ. You
            should not use a field from elsewhere, because its parameters would not follow the fitted ones. By default
            each quantity of `space` is an output of its name, for example "velocity", or "x[0]" if the field has no
            state space. Those that no record has are left out.
        start: the expected initial state (d,). You must give it.
        spread: the standard deviation of the initial state about `start` (d,). It should be 0 if you know it, infinite
            if you know nothing about it. An attitude has three numbers here, its rotation [rad].
        process: the standard deviation of the process noise on each state, per square root of a second; by default 0.
            It should have the shape of `spread`. A state with process noise and no dynamics is a random walk.
        angles: the names of outputs that are angles [rad], of which whole turns do not matter; those of the state space
            are known by default.
        noise: the standard deviation of the measured outputs' errors by name, in the unit of the output: one number, or
            one for each component; three rotation angles [rad] for an attitude. A fit estimates those that are not
            given, and its model has all.

    Raises:
        ValueError: if sizes do not agree, a deviation is negative, or an angle or a noise is of no output.
    """

    field: AbstractVectorField
    inputs: tuple[str, ...] = eqx.field(static=True, converter=tuple)
    outputs: Mapping[str, Output] = eqx.field(converter=_ordered, default=None)  # pyright: ignore[reportAssignmentType]
    start: tuple[float, ...] = eqx.field(static=True, converter=_numbers, default=())
    spread: tuple[float, ...] = eqx.field(static=True, converter=_numbers, default=())
    process: tuple[float, ...] = eqx.field(static=True, converter=_numbers, default=())
    angles: tuple[str, ...] = eqx.field(static=True, converter=tuple, default=())
    noise: Mapping[str, tuple[float, ...]] = eqx.field(converter=_numbers_by_name, default_factory=dict)

    def __post_init__(self):
        if self.outputs is None:
            self.outputs = _ordered({one.name: Measured((at.start, at.stop), one) for at, one in self.space.parts})
            self.angles = (*self.angles, *(one.name for one in self.space.quantities if isinstance(one, Angle)))

    def __check_init__(self):
        if not self.start:
            raise ValueError("start must be given: the expected initial state")
        if not self.outputs:
            raise ValueError("outputs: at least one is needed, for example {'angle': lambda x, u: x[0]}")
        for name, chosen in (("angles", self.angles), ("noise", self.noise)):
            if unknown := [each for each in chosen if each not in self.outputs]:
                known = ", ".join(self.outputs)
                raise ValueError(f"{name} must be names of outputs, {known}, got {', '.join(unknown)}")
        for name, sizes in self.noise.items():
            for number in sizes:
                checks.positive(f"noise of {name}", number)
        expected = self.space.tangent_size
        for name, numbers in (("spread", self.spread), ("process", self.process)):
            if len(numbers) not in ((0, expected) if name == "process" else (expected,)):
                raise ValueError(f"{name} must have {expected} numbers, like a change of start, got {len(numbers)}")
            for number in numbers:
                if not number >= 0:
                    raise ValueError(f"{name} must not be negative, got {number}")

    @property
    def size(self) -> int:
        """The number d of states."""
        return len(self.start)

    @property
    def space(self) -> StateSpace:
        """The state space of the field, with a quantity for each state that it does not describe."""
        return state_space(self.field, self.size)

    def begin(self, x0: Float[Array, " d"], u: Float[Array, "t m"], dt: float):
        """Return the initial state of a piece of a record, and the inputs of its intervals.

        Args:
            x0: the unknown initial state (d,).
            dt: length of an interval [s].
        """
        return x0, u

    def output(self, name: str, x: Float[Array, " d"], u: Float[Array, " m"]) -> Float[Array, " k"]:
        """Compute an output (k,) in the state x under the input u, in the unit of its measurement.

        Args:
            name: name of the output.
        """
        h = self.outputs[name]
        own = (self.field,) if len(inspect.signature(h).parameters) > 2 else ()
        y = jnp.atleast_1d(jnp.asarray(h(x, u, *own)))
        if y.ndim != 1:
            raise ValueError(f"outputs: {name} must return a scalar or one axis, got shape {y.shape}")
        return y

    def error(self, name: str, predicted: Float[Array, " k"], y: Float[Array, " k"]) -> Float[Array, " e"]:
        """Subtract the measurement from the prediction.

        Args:
            name: name of the output.
            predicted: as returned by `output` (k,).
            y: the measurement (k,).
        """
        if isinstance(h := self.outputs[name], Measured):
            return h.quantity.difference(predicted, y)
        return ANGLE.difference(predicted, y) if name in self.angles else predicted - y

    def only(self, names: Iterable[str]) -> "StateSpaceModel":
        """Return the model with some of its outputs.

        Args:
            names: their names.
        """
        outputs = {name: self.outputs[name] for name in names}
        noise = {name: size for name, size in self.noise.items() if name in outputs}
        return replace(self, outputs=outputs, angles=[name for name in self.angles if name in outputs], noise=noise)


def dynamics_of(learner: Any) -> Any:
    """Return the field of a `StateSpaceModel`, or what is none itself."""
    return learner.field if isinstance(learner, StateSpaceModel) else learner
