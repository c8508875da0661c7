"""Unmeasured parts of a system, with their own states behind the field's: lags, delays, disturbances and loads."""

import math
from abc import abstractmethod
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from hybrid_jax import checks
from hybrid_jax.dynamics.base import AbstractVectorField, as_field, jvp_columns, state_space

Indices = tuple[int, ...]


def _at(places: Indices, values: Float[Array, " k"], d: int) -> Float[Array, " d"]:
    return jnp.zeros(d).at[jnp.array(places)].set(values)


class AbstractHidden(eqx.Module):
    """A hidden part with its own states z. Every array inside is learned."""

    @property
    @abstractmethod
    def size(self) -> int:
        """The number of its states k."""

    @abstractmethod
    def derivative(self, z: Float[Array, " k"], x: Float[Array, " d"], u: Float[Array, " m"]) -> Float[Array, " k"]:
        """Return ż (k,), for the states x of the field and the inputs u that the part before passes on.

        Args:
            z: its states (k,).
        """

    def inputs(self, z: Float[Array, " k"], u: Float[Array, " m"]) -> Float[Array, " m"]:
        """Return the inputs (m,) that this part passes on; by default u.

        Args:
            z: its states (k,).
        """
        return u

    def added(self, z: Float[Array, " k"], d: int) -> Float[Array, " d"]:
        """Return the contribution (d,) to ẋ of the field; by default zero.

        Args:
            z: its states (k,).
            d: the number of states of the field.
        """
        return jnp.zeros(d)


class Lag(AbstractHidden):
    """A lag of inputs, ż = (u − z) / τ, or a chain of equal lags, which delays them. The field receives z.

    The delay of a chain is spread about τ by τ / √order (MacDonald, Time Lags in Biological Models, 1978).

    Attributes:
        log_time_constant: ln τ of each lagged input (k,), with τ in seconds: the sum over the chain.
        places: indices of the lagged inputs.
        order: number of lags in the chain. For a delay, you should choose four.
    """

    log_time_constant: Float[Array, " k"]
    places: Indices = eqx.field(static=True)
    order: int = eqx.field(static=True, default=1)

    @property
    def size(self) -> int:
        return len(self.places) * self.order

    def derivative(self, z, x, u):
        chain = z.reshape(self.order, -1)
        before = jnp.concatenate([u[jnp.array(self.places)][None], chain[:-1]])
        return ((before - chain) * self.order / jnp.exp(self.log_time_constant)).ravel()

    def inputs(self, z, u):
        return jnp.asarray(u).at[jnp.array(self.places)].set(z.reshape(self.order, -1)[-1])


class RandomWalk(AbstractHidden):
    """A disturbance of ẋ that is a random walk if it has process noise, and constant otherwise.

    Attributes:
        places: indices of the states of the field that it acts on.
    """

    places: Indices = eqx.field(static=True)

    @property
    def size(self) -> int:
        return len(self.places)

    def derivative(self, z, x, u):
        return jnp.zeros_like(z)

    def added(self, z, d):
        return _at(self.places, z, d)


class Oscillator(AbstractHidden):
    """A damped oscillator that acts on the field, for example a load on a cable.

    Its states are a and ȧ, with ä = −ω² a − 2 ζ ω ȧ + w · (x, u), and it adds g a to ẋ.

    Attributes:
        log_frequency: ln ω, with ω in rad/s.
        log_damping: ln ζ.
        drive: weight w of each state and input (d + m,).
        gain: gain g of each state that it acts on (k,).
        places: indices of the states of the field that it acts on.
    """

    log_frequency: Float[Array, ""]
    log_damping: Float[Array, ""]
    drive: Float[Array, " n"]
    gain: Float[Array, " k"]
    places: Indices = eqx.field(static=True)

    @property
    def size(self) -> int:
        return 2

    def derivative(self, z, x, u):
        frequency, pushed = jnp.exp(self.log_frequency), self.drive @ jnp.concatenate([x, u])
        return jnp.stack([z[1], pushed - frequency**2 * z[0] - 2 * jnp.exp(self.log_damping) * frequency * z[1]])

    def added(self, z, d):
        return _at(self.places, self.gain * z[0], d)


class LinearDynamics(AbstractHidden):
    """Hidden linear dynamics: ż = A z + B (x, u), which adds C z to ẋ.

    Attributes:
        a: the matrix A (k, k).
        b: the matrix B (k, d + m), with a column for each state and input.
        c: the matrix C (s, k), with a row for each state that it acts on.
        places: indices of the states of the field that it acts on (s).
    """

    a: Float[Array, "k k"]
    b: Float[Array, "k n"]
    c: Float[Array, "s k"]
    places: Indices = eqx.field(static=True)

    @property
    def size(self) -> int:
        return len(self.a)

    def derivative(self, z, x, u):
        return self.a @ z + self.b @ jnp.concatenate([x, u])

    def added(self, z, d):
        return _at(self.places, self.c @ z, d)


class WithHidden(AbstractVectorField):
    """A field with hidden parts, whose states follow the states of the field."""

    field: AbstractVectorField
    parts: tuple[AbstractHidden, ...]

    @property
    def hidden(self) -> int:
        """The number of states of the parts, which follow the states of the field."""
        return sum(part.size for part in self.parts)

    def __call__(self, x: Float[Array, " d"], u: Float[Array, " m"]) -> Float[Array, " d"]:
        d, own, slopes = len(x) - self.hidden, x[: len(x) - self.hidden], []
        at, added = d, jnp.zeros(d)
        for part in self.parts:
            z = x[at : at + part.size]
            slopes.append(part.derivative(z, own, u))
            u, added, at = part.inputs(z, u), added + part.added(z, d), at + part.size
        return jnp.concatenate([self.field(own, u) + added, *slopes])


def with_hidden(field: AbstractVectorField, *parts: AbstractHidden) -> WithHidden:
    """Add hidden parts to a field, any number of each kind. Their states follow the states of the field.

    Args:
        field: the field that the parts act on.
        parts: for example `Lag`, `RandomWalk`, `Oscillator` and `LinearDynamics`. The first receives the inputs, each
            further one the output of the one before. ValueError if there is no part, or something is not a part.
    """
    return WithHidden(field, tuple(checks.list_of("parts", parts, AbstractHidden)))


class DisturbanceModel(AbstractVectorField):
    """A disturbance predicted from its past: ẋ = f(x, u) + D e, żᵢ = (e − zᵢ) / τᵢ, e = W (z₁ − z₂, …, z_k, x, 1).

    The state is (x, z₁, …, z_k). e is the disturbance in the tangent space of x, D its effect on ẋ, and zᵢ is e after a
    low-pass filter. W reads differences of adjacent filters, because the filters themselves are nearly equal. While x
    is measured, e is the measured disturbance instead: see `after`, and `hybrid_jax.estimation.observe` for many
    samples. This is an innovations form of linear hidden dynamics (Ljung, System Identification, 1999, 4.3) with fixed
    poles.

    Attributes:
        field: f, with d states and e numbers in their tangent space.
        weights: W (e, k e + n + 1), in the units of ẋ, z and x.
        sizes: the variation of z₁ (k times) and of x in the data of the first fit, in their units, and 1 (k e + n + 1);
            infinite for a state that did not vary.
        time_constants: time constants τ₁ < … < τ_k of the filters [s].
        states: indices of the n states that W reads.
    """

    field: AbstractVectorField
    weights: Float[Array, "e f"]
    sizes: Float[Array, " f"]
    time_constants: tuple[float, ...] = eqx.field(static=True)
    states: tuple[int, ...] = eqx.field(static=True)

    @property
    def hidden(self) -> int:
        """The number of filter states, which follow the states of the field."""
        return len(self.time_constants) * len(self.weights)

    @property
    def state_space(self):
        own = state_space(self.field)
        return own.padded(own.size + self.hidden)

    def disturbance(self, x: Float[Array, " d+f"]) -> Float[Array, " e"]:
        """Predict the disturbance e (e,) in a state, in the state's units per second.

        Args:
            x: the state of the field, followed by the states of the filters.
        """
        filtered = x[len(x) - self.hidden :].reshape(-1, len(self.weights))
        bands = -jnp.diff(filtered, axis=0, append=0 * filtered[:1])
        return self.weights @ jnp.concatenate([bands.ravel(), x[jnp.array(self.states, int)], jnp.ones(1, x.dtype)])

    def after(
        self, x: Float[Array, " d+f"], predicted: Float[Array, " d"], measured: Float[Array, " d"], dt: float
    ) -> Float[Array, " d+f"]:
        """Return the state after a sample, which you pass to the next call. At first, the filters should be zero.

        Args:
            x: the state at the previous sample.
            predicted: the field's prediction of this sample from there (d,).
            measured: the sample (d,).
            dt: time between the two samples [s].
        """
        e = state_space(self.field, len(measured)).difference(measured, predicted) / dt
        filtered = x[len(measured) :].reshape(-1, len(e))
        shares = jnp.array([-math.expm1(-dt / tau) for tau in self.time_constants], e.dtype)
        filtered = filtered + shares[:, None] * (e - filtered)
        return jnp.concatenate([measured, filtered.ravel()])

    def __call__(self, x: Float[Array, " d+f"], u: Float[Array, " m"]) -> Float[Array, " d+f"]:
        d, beyond = len(x) - self.hidden, self._beyond(x)
        return jnp.concatenate([self.field(x[:d], u) + beyond[:d], beyond[d:]])

    def linearize(self, x, u, dx, du):
        d, (beyond, slopes) = len(x) - self.hidden, jvp_columns(self._beyond, (x,), (dx,))
        value, columns = as_field(self.field).linearize(x[:d], u, dx[:d], du)
        parts = (value, beyond), (columns, slopes)
        return tuple(jnp.concatenate([own + more[:d], more[d:]]) for own, more in parts)

    def fuse_for_inference(self):
        return eqx.tree_at(lambda model: model.field, self, as_field(self.field).fuse_for_inference())

    def _beyond(self, x: Float[Array, " d+f"]) -> Float[Array, " d+f"]:
        """Return ẋ without the contribution of the field."""
        own, filtered = x[: len(x) - self.hidden], x[len(x) - self.hidden :]
        e = self.disturbance(x)
        retract = partial(state_space(self.field, len(own)).retract, own)
        _, effect = jax.jvp(retract, (jnp.zeros_like(e),), (e,))
        slopes = (e - filtered.reshape(-1, len(e))) / jnp.array(self.time_constants, x.dtype)[:, None]
        return jnp.concatenate([effect, slopes.ravel()])
