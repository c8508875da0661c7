"""Estimate all states of a partly measured system, one sample at a time."""

from itertools import accumulate

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hybrid_jax import checks
from hybrid_jax.dynamics.base import AbstractEstimator, as_field, in_double
from hybrid_jax.dynamics.outputs import StateSpaceModel
from hybrid_jax.integrate import rk4_step
from hybrid_jax.online.kalman import Belief, measured, triangular


class StateEstimate(eqx.Module):
    """The estimated states of a system.

    Attributes:
        x: the states (d,).
        root: a square root of the covariance of their error, a change of x in its tangent space (e, e).
    """

    x: Float[Array, " d"]
    root: Float[Array, "e e"]

    @property
    def deviation(self) -> Float[Array, " e"]:
        """The standard deviation of the error, a change of x in its tangent space (e,)."""
        return jnp.sqrt(jnp.sum(jnp.square(self.root), axis=1))


class ExtendedKalmanFilter(AbstractEstimator):
    """Estimate all states of a system from its outputs, also hidden ones, for example for a controller.

    This is the filter of `StateSpaceModel`, of which `hybrid_jax.estimation.predict` estimates the state from a whole
    record. It is linearised in the tangent space of the state, and works with square roots of covariances (Bierman,
    "Factorization methods for discrete sequential estimation", 1977, ch. II). A sample joins the outputs of the model
    in their order; an output with a number that is NaN was not measured.

    Attributes:
        system: the model, with the noise of all its outputs. Its start and spread are what you know about the state at
            the first sample, and its process noise says how far hidden states walk.
        dt: time between two samples [s].
        substeps: number of steps of RK4 between two samples.
        robust: an output that is further from its prediction than this number of standard deviations counts as if it
            were that far (Huber 1964).

    Raises:
        ValueError: if the noise of an output is unknown, the spread is infinite, or a number is out of range.
    """

    system: StateSpaceModel
    dt: float = eqx.field(static=True)
    substeps: int = eqx.field(static=True, default=1)
    robust: float = eqx.field(static=True, default=np.inf)

    def __check_init__(self):
        checks.positive("dt", self.dt)
        checks.count("substeps", self.substeps, 1)
        if not self.robust > 0:
            raise ValueError(f"robust must be positive, got {checks.short_repr(self.robust)}")
        if unknown := [name for name in self.system.outputs if name not in self.system.noise]:
            remedy = "give it to the model, or take the model of a fit"
            raise ValueError(f"the noise of {', '.join(unknown)} must be known: {remedy}")
        if not np.isfinite(self.system.spread).all():
            raise ValueError(f"spread must be finite for a filter, got {self.system.spread}")

    def begin(self, x: Float[Array, " k"], u: Float[Array, " m"] | None = None) -> StateEstimate:
        """Return the estimate at the first sample.

        Args:
            x: the sample (k,).
            u: the input before it, if an output depends on it.
        """
        self, x = in_double(self), jnp.asarray(x)  # in single precision, unless JAX has double enabled
        start, spread = (jnp.asarray(part, x.dtype) for part in (self.system.start, self.system.spread))
        return self._corrected(StateEstimate(start, jnp.diag(spread)), x, u)

    def update(self, state, x, u):
        self = in_double(self)
        space, none = self.system.space, jnp.zeros(len(state.root), state.x.dtype)
        moved, push = jax.linearize(lambda change: self._moved(space.retract(state.x, change), u), none)
        tangent = jax.linearize(lambda reached: space.difference(reached, moved), moved)[1]
        # In a loop, which is small in C.
        slope = jax.lax.map(lambda change: tangent(push(change)), jnp.eye(len(none), dtype=none.dtype)).T
        walk = jnp.asarray(self.system.process or none, moved.dtype) * self.dt**0.5
        root = jnp.concatenate([slope @ state.root, jnp.diag(walk)], axis=1)
        return self._corrected(StateEstimate(moved, root), x, u)

    def model(self, state):
        return as_field(self.system.field)

    def start(self, state, x):
        return state.x

    def _moved(self, x: Float[Array, " d"], u: Float[Array, " m"]) -> Float[Array, " d"]:
        for _ in range(self.substeps):
            x = rk4_step(self.system.field, x, u, self.dt / self.substeps)
        return self.system.space.projected(x)

    def _corrected(self, state: StateEstimate, y: Float[Array, " k"], u) -> StateEstimate:
        """Correct the predicted state by a sample, linearised where it was predicted."""
        retract, none = self.system.space.retract, jnp.zeros(len(state.root), y.dtype)
        predicted = {name: self.system.output(name, state.x, u) for name in self.system.outputs}
        ends, parts = [*accumulate(map(len, predicted.values()), initial=0)], []
        if y.shape != (ends[-1],):
            raise ValueError(f"a sample must have shape ({ends[-1]},), for {', '.join(predicted)}, got {y.shape}")
        for (name, value), begin in zip(predicted.items(), ends, strict=False):
            own = y[begin : begin + len(value)]
            seen = ~jnp.isnan(jnp.sum(own))
            own = jnp.where(seen, own, value)

            def error(change, name=name, own=own):
                return self.system.error(name, self.system.output(name, retract(state.x, change), u), own)

            errors, rows = jnp.where(seen, error(none), 0.0), jnp.where(seen, jax.jacfwd(error)(none), 0.0)
            parts.append((errors, rows, jnp.broadcast_to(jnp.asarray(self.system.noise[name], y.dtype), errors.shape)))

        def correct(estimate, number):
            (change, root), (error, row, noise) = estimate, number
            variance, gain, root = measured(row @ root, root, noise**2)
            white = jnp.clip((error + row @ change) / jnp.sqrt(variance), -self.robust, self.robust)
            return (change - gain * white, root), None

        numbers = map(jnp.concatenate, zip(*parts, strict=True))
        change, root = jax.lax.scan(correct, (none, state.root), tuple(numbers))[0]
        x = retract(state.x, change)
        return StateEstimate(x, triangular(Belief(x, root), len(root)).root)
