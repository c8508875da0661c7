"""The meaning of a state's numbers, to perturb and compare states that are not vectors, for example attitudes."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import accumulate, chain

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hybrid_jax import checks, rotation
from hybrid_jax.checks import Numbers

Change = Float[Array, " e"]  # of a state or a quantity, in the tangent space


@dataclass(frozen=True)
class Quantity:
    """Numbers of a state that form one vector. For a manifold of your own, you should write a subclass.

    Attributes:
        name: its name, for example "velocity".
        size: the number of entries of the state that it has.
        unit: the unit of its entries, for example "m/s"; empty without a unit.
        labels: a short name of each entry, for example ("vx", "vy", "vz"); empty to use their indices. ValueError for
            another number of them.
        scale: the norm of a typical small difference of the quantity, in its unit.
        uniform: whether its numbers are one quantity at many points, so that a constant disturbance is one number, and
            an expected error is that at one point.
    """

    name: str
    size: int = 1
    unit: str = ""
    labels: tuple[str, ...] = ()
    scale: float = 1.0
    uniform: bool = False

    def __post_init__(self):
        checks.count("size", self.size)
        if len(self.labels) not in (0, self.size):
            raise ValueError(f"labels of {self.name} must be one for each of size={self.size}, got {self.labels}")

    @property
    def tangent_size(self) -> int:
        """The dimension of the tangent space."""
        return self.size

    @property
    def is_vector(self) -> bool:
        """Whether you add a change and subtract values, as in a vector space."""
        return type(self) is Quantity

    def retract(self, x: Float[Array, " n"], change: Change) -> Float[Array, " n"]:
        """Return the value after a change.

        Args:
            change: a tangent vector at x.
        """
        return x + change

    def difference(self, y: Float[Array, " n"], x: Float[Array, " n"]) -> Change:
        """Return the change that leads from x to y: `retract(x, difference(y, x))` is y.

        Args:
            y: the other value (n).
        """
        return y - x

    def normalise(self, x: Float[Array, " n"]) -> Float[Array, " n"]:
        """Return the usual representation of a value near x, for example a unit quaternion."""
        return x

    def nearest(self, x: Float[Array, " n"], to: Float[Array, " n"]) -> Float[Array, " n"]:
        """Return the representation of x that is nearest to another value's numbers.

        Args:
            to: the numbers of the other value (n).
        """
        return x

    def continuous(self, path: Float[np.ndarray, "t n"]) -> Float[np.ndarray, "t n"]:
        """Return a sequence of values without jumps between representations.

        Args:
            path: values in the order of time (t, n).
        """
        return path

    def check(self, name: str, x: Numbers, part: slice) -> None:
        """Raise ValueError if this quantity is invalid in one of the states x (…, d).

        Args:
            name: what the message calls the states.
            part: which of their numbers belong to the quantity.
        """


@dataclass(frozen=True)
class Angle(Quantity):
    """Angles [rad], of which whole turns do not matter."""

    unit: str = "rad"

    def difference(self, y, x):
        return self.normalise(y - x)

    def normalise(self, x):
        return x - 2 * jnp.pi * jnp.floor(x / (2 * jnp.pi) + 0.5)

    def nearest(self, x, to):
        return to + self.normalise(x - to)

    def continuous(self, path):
        return np.unwrap(path, axis=-2)


@dataclass(frozen=True)
class Attitude(Quantity):
    """An attitude as a unit quaternion (w, x, y, z), body → world; changes are rotation vectors [rad, body frame]."""

    size: int = 4
    unit: str = "rad"
    scale: float = 2.0  # of a small angle θ the quaternion differs by θ / 2

    @property
    def tangent_size(self):
        return 3

    def retract(self, x, change):
        return rotation.normalise(rotation.multiply(x, rotation.from_rotation_vector(change)))

    def difference(self, y, x):
        return rotation.attitude_error(x, y)

    def normalise(self, x):
        return rotation.normalise(x)

    def nearest(self, x, to):
        return jnp.where(jnp.sum(x * to) < 0, -x, x)

    def continuous(self, path):
        turned = np.sum(path[..., 1:, :] * path[..., :-1, :], axis=-1) < 0
        signs = np.cumprod(np.where(turned, -1, 1), axis=-1)[..., None].astype(path.dtype)
        return np.concatenate([path[..., :1, :], signs * path[..., 1:, :]], axis=-2)

    def check(self, name, x, part):
        checks.unit_quaternions(name, x, part)


@dataclass(frozen=True)
class StateSpace:
    """A sequence of quantities with d numbers in total, which a field defines by its attribute `state_space`.

    Attributes:
        quantities: in the order of the state; empty if nothing is known about it.
        disturbed: indices of the states on which a constant disturbance acts by default; None for all. The rates of
            the others should follow from the state, for example of a position from the velocity.
    """

    quantities: tuple[Quantity, ...] = ()
    disturbed: slice | None = None

    @property
    def size(self) -> int:
        """The size d of a state; 0 if nothing is known about it."""
        return sum(quantity.size for quantity in self.quantities)

    @property
    def parts(self) -> tuple[tuple[slice, Quantity], ...]:
        """Each quantity with its slice of the state."""
        ends = accumulate(quantity.size for quantity in self.quantities)
        return tuple((slice(end - one.size, end), one) for end, one in zip(ends, self.quantities, strict=True))

    @property
    def names(self) -> tuple[str, ...]:
        """The name of each number of the state: its label or its index."""
        labels = (one.labels or map(str, range(part.start, part.stop)) for part, one in self.parts)
        return tuple(chain.from_iterable(labels))

    @property
    def units(self) -> tuple[str, ...]:
        """The unit of each number of the state."""
        return tuple(one.unit for one in self.quantities for _ in range(one.size))

    @property
    def tangent_size(self) -> int:
        """The dimension of the state's tangent space."""
        return sum(quantity.tangent_size for quantity in self.quantities)

    @property
    def tangent_names(self) -> list[str]:
        """The name of each number of a change of the state, for example "attitude[0]"."""
        sizes = [(one.name, one.tangent_size) for one in self.quantities]
        return [name if size == 1 else f"{name}[{i}]" for name, size in sizes for i in range(size)]

    def padded(self, d: int) -> "StateSpace":
        """Return this space, extended to d numbers by quantities x[i]; only these if d is too small.

        Args:
            d: the size of a state.
        """
        if d == self.size:
            return self
        known = self if d > self.size else StateSpace()
        return replace(known, quantities=(*known.quantities, *(Quantity(f"x[{i}]") for i in range(known.size, d))))

    def retract(self, x: Float[Array, " d"], change: Change) -> Float[Array, " d"]:
        """Return the state after a change.

        Args:
            change: a tangent vector at x (e), quantity by quantity.
        """
        ends = [*accumulate((one.tangent_size for one in self.quantities), initial=0)]
        pairs = zip(self.parts, ends, strict=False)
        return jnp.concatenate([q.retract(x[at], change[i : i + q.tangent_size]) for (at, q), i in pairs])

    def difference(self, y: Float[Array, " d"], x: Float[Array, " d"]) -> Change:
        """Return the change (e) that leads from x to y.

        Args:
            y: the other state (d).
        """
        return jnp.concatenate([one.difference(y[part], x[part]) for part, one in self.parts])

    def normalise(self, x: Float[Array, " d"]) -> Float[Array, " d"]:
        """Return the usual representation of the state, for example with unit quaternions."""
        for part, one in self._curved():
            x = x.at[part].set(one.normalise(x[part]))
        return x

    def projected(self, x: Float[Array, " d"]) -> Float[Array, " d"]:
        """Return the valid state nearest to x, which rounding or a solver step may have moved off the manifold."""
        return self.nearest(self.normalise(x), x)

    def nearest(self, x: Float[Array, " d"], to: Float[Array, " d"]) -> Float[Array, " d"]:
        """Return the representation of x that is nearest to another state's numbers.

        Args:
            to: the other state (d).
        """
        for part, one in self._curved():
            x = x.at[part].set(one.nearest(x[part], to[part]))
        return x

    def canonical(self, x: Float[Array, " d *b"], own: Float[Array, " d *b"]) -> Float[Array, " d *b"]:
        """Return x, or a derivative there, as networks read it: with the one of q and −q that has w ≥ 0.

        Args:
            own: x itself or a derivative (d), which changes as x does.
        """
        for part, one in self.parts:
            if isinstance(one, Attitude):
                turned = jnp.where(x[part.start] < 0, -own[part], own[part])
                own = jnp.concatenate([own[: part.start], turned, own[part.stop :]])
        return own

    def check(self, name: str, x: Numbers) -> None:
        """Raise ValueError, with the index, if one of the states x (…, d) is invalid, for example has |q| ≠ 1.

        Args:
            name: what the message calls the states.
        """
        for part, one in self._curved():
            one.check(name, x, part)

    def features(self, x: Float[np.ndarray, "n d"], u: Float[np.ndarray, "n m"]) -> dict[str, np.ndarray]:
        """Return, by name, the quantities that decide how alike samples are; by default each number of x and of u.

        All numbers of a `uniform` quantity are samples of one.
        """
        found = {}
        for part, one in self.padded(x.shape[1]).parts:
            # Two quantities may have equal labels, for example "left" of an angle and of its rate.
            names = [one.name + f" {each}" * (one.size > 1) for each in one.labels or range(one.size)]
            found |= {one.name: x[:, part].ravel()} if one.uniform else dict(zip(names, x[:, part].T, strict=True))
        return found | {f"u[{i}]": column for i, column in enumerate(u.T)}

    def _curved(self) -> Iterator[tuple[slice, Quantity]]:
        return ((part, one) for part, one in self.parts if not one.is_vector)
