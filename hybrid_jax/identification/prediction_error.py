"""Predictions of windows of measurements, their errors, and their normal equations; see `fitting`."""

from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hybrid_jax.chunks import in_chunks
from hybrid_jax.dynamics.actuators import Actuated, held_means
from hybrid_jax.dynamics.base import AbstractVectorField
from hybrid_jax.dynamics.disturbance import physics_of
from hybrid_jax.dynamics.measurement import difference, measure
from hybrid_jax.dynamics.rigid_body import RIGID_BODY_SPACE
from hybrid_jax.estimation.elimination import Equations
from hybrid_jax.estimation.least_squares import ravel_parameters
from hybrid_jax.identification import slow_commands
from hybrid_jax.identification.recordings import Inputs, Layout, Windows
from hybrid_jax.integrate import RK4, integrate
from hybrid_jax.state import STATE_SIZE, VELOCITY

CHUNK = 64  # windows at a time
TANGENT = RIGID_BODY_SPACE.tangent_size


class Problem(NamedTuple):
    """What does not change while parameters are fitted."""

    windows: Windows
    inputs: Inputs
    columns: dict[str, tuple[int, ...]]  # of each quantity, which of its axes were measured
    scale: dict[str, Array]
    spread: Float[Array, "n 18"]  # of the priors: initial states, constant accelerations and angular accelerations
    whitening: Float[Array, "n r r"] | None = None  # of a window's errors in units of their scale; see `between`


class Pushed(AbstractVectorField):
    """A field with a constant acceleration and angular acceleration (6) in its v̇ and ω̇."""

    field: AbstractVectorField
    push: Float[Array, "6"]

    def __call__(self, x, u):
        return self.field(x, u).at[VELOCITY.start : STATE_SIZE].add(self.push)

    def speeds(self, x, u):
        return physics_of(self.field).speeds(x, u)  # pyright: ignore[reportAttributeAccessIssue]


def errors_of(
    field, theta, change, window: Windows, inputs: Inputs, columns, layout: Layout, strayed=None
) -> dict[str, Array]:
    """y − ŷ of one window for parameters and a change of its initial state; 0 where nothing was measured.

    `strayed` are the ξ of `between`, by default zero.
    """
    _, unravel = ravel_parameters(field)
    field, ahead = unravel(theta), layout.ahead
    physics, x = physics_of(field), RIGID_BODY_SPACE.retract(jnp.asarray(window.start), change[:TANGENT])
    delay = physics.delay if isinstance(physics, Actuated) else 0.0
    u = held_means(inputs.t, inputs.values, window.edges, delay)
    if strayed is not None:
        u = u + slow_commands.means(strayed, window.between, inputs.root, window.edges, delay)
    if isinstance(physics, Actuated):
        if physics.reads_voltage:
            u = jnp.concatenate([u, window.voltage[:, None]], axis=1)
        if physics.rotor_states:
            x = jnp.concatenate([x, physics.settled(u[:ahead] if ahead else u[:1], layout.dt)])
    u = u[ahead:]
    pushed = Pushed(field, change[TANGENT:])
    states = integrate(pushed, x, u, layout.dt, RK4())
    found = {}
    for name, y in window.y.items():
        predicted = jax.vmap(partial(measure, name, pushed))(states, u)
        error = jax.vmap(partial(difference, name))(y, predicted[:, np.array(columns[name])])
        found[name] = jnp.where(window.there[name][:, None], error, 0.0)
    return found


@eqx.filter_jit
def all_errors(field, theta, changes, problem: Problem, layout: Layout):
    def one(each):
        window, change = each
        return errors_of(field, theta, change, window, problem.inputs, problem.columns, layout)

    return in_chunks(jax.vmap(one), (problem.windows, changes), CHUNK)


@eqx.filter_jit
def slopes_between(field, theta, changes, problem: Problem, layout: Layout):
    """∂ŷ/∂ξ of what commands do between samples: (n, t, k, ξ) of each quantity."""
    size = problem.windows.between.shape[1] * slow_commands.MODES * len(problem.inputs.root)

    def one(each):
        window, change = each

        def of(strayed):
            return errors_of(field, theta, change, window, problem.inputs, problem.columns, layout, strayed)

        return jax.jacfwd(of)(jnp.zeros(size))

    return in_chunks(jax.vmap(one), (problem.windows, changes), CHUNK)


@eqx.filter_jit
def rms(field, theta, changes, problem: Problem, layout: Layout) -> dict[str, Array]:
    found = all_errors(field, theta, changes, problem, layout)
    counts = {name: jnp.sum(there) for name, there in problem.windows.there.items()}
    return {name: jnp.sqrt(jnp.sum(part**2, axis=(0, 1)) / counts[name]) for name, part in found.items()}


@eqx.filter_jit
def normal_equations(field, problem: Problem, layout: Layout, theta, changes) -> Equations:
    """The normal equations of each window in θ and in the change of its initial state and its disturbance."""

    def one(each) -> Equations:
        (window, spread, whitening), change = each
        p, free = theta.size, spread > 0

        def residual(both):
            found = errors_of(field, both[:p], both[p:], window, problem.inputs, problem.columns, layout)
            r = jnp.concatenate([jnp.ravel(part / problem.scale[name]) for name, part in found.items()])
            r = r if whitening is None else whitening @ r
            return r, r

        # A prior of one standard deviation on each initial state; those that are exact do not move.
        jacobian, r = jax.jacfwd(residual, has_aux=True)(jnp.concatenate([theta, change]))
        gram, score, cost = Equations.of_errors(jacobian.at[:, p:].multiply(free), r)
        known = 1 / jnp.square(jnp.where(free, spread, 1.0))
        gram, score = gram.at[p:, p:].add(jnp.diag(known)), score.at[p:].add(known * change)
        return Equations(gram, score, cost + jnp.sum(known * change**2))

    every = problem.windows, problem.spread, problem.whitening
    return in_chunks(jax.vmap(one), (every, changes), CHUNK)
