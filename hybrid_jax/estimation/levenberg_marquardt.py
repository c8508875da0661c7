"""Levenberg–Marquardt (Levenberg 1944; Marquardt 1963) for all least-squares fits.

Unlike Optimistix, it compiles one evaluation for the start, the steps and the end, allows any elimination, and stops at
the limit of rounding.
"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PyTree

from hybrid_jax.batches import solve
from hybrid_jax.status import Status

DAMPING = 1e-3  # at the start, relative to the diagonal of JᵀJ; Madsen, Nielsen and Tingleff (2004), Eq. 3.14
SMALLEST, LARGEST = 1e-12, 1e8  # damping; with more, no step lowers the cost
HIDDEN = 10  # rounding of the sum of squares, in roundings of one number
PROMISED = 1e-3  # of the cost: a fit that no step lowers has stalled if more was expected without damping
SLOW = 2  # steps in a row that lower the cost by less than the tolerance end the fit

Move = tuple[Float[Array, " p"], Float[Array, ""]]  # a step, and by how much it should lower the cost


class State(NamedTuple):
    """The best point so far, and the next one to try."""

    best: PyTree  # results at the best point, including the point itself
    cost: Float[Array, ""]  # the sum of squares there
    tried: PyTree  # the point to try
    expected: Float[Array, ""]  # expected decrease of the cost at that point
    last: Bool[Array, ""]  # whether this decrease is below rounding
    damping: Float[Array, ""]  # relative to the diagonal of JᵀJ
    steps: Int[Array, ""]  # points that were tried
    slow: Int[Array, ""]  # how many steps in a row lowered the cost by less than the tolerance
    converged: Bool[Array, ""]  # whether the last step was tried, or `SLOW` were slow

    @property
    def running(self) -> Bool[Array, ""]:
        """Whether a point is left to try, regardless of the number of steps."""
        return ~self.converged & (self.damping <= LARGEST) & ((self.steps == 0) | jnp.isfinite(self.cost))

    @property
    def status(self) -> Int[Array, ""]:
        stalled = ~self.converged & (self.damping > LARGEST)
        ended = jnp.where(self.converged, Status.OK, jnp.where(stalled, Status.STALLED, Status.CAPPED))
        return jnp.where(jnp.isfinite(self.cost) | stalled, ended, Status.DIVERGED).astype(jnp.int32)


def begin(point: PyTree, found: PyTree, damping: float = DAMPING) -> State:
    """Return the state before the first point is tried; `found` has the shapes of the results at a point."""
    zero, none, no = jnp.zeros(()), jnp.zeros((), jnp.int32), jnp.array(False)
    return State(found, jnp.full((), jnp.inf), point, zero, no, jnp.full((), damping), none, none, no)


def judged(state: State, cost: Float[Array, ""], tolerance: float = 0.0) -> tuple[Bool[Array, ""], State]:
    """Accept or reject the point that was tried, and update the damping (Madsen, Nielsen and Tingleff 2004, Eq. 2.21).

    A step that achieves half of the expected decrease keeps the damping: a stricter rule stops in curved valleys.
    """
    first, change = state.steps == 0, cost - state.cost
    accepted = first | (change <= -0.01 * state.expected) | (state.last & jnp.isfinite(change))
    gain = jnp.clip(-change / jnp.where(state.expected > 0, state.expected, 1), 0, 1)
    factor = jnp.where(first, 1, jnp.where(accepted, jnp.maximum(1 / 3, 1 - (2 * gain - 1) ** 3), 4))
    damping = jnp.maximum(state.damping * factor, SMALLEST)
    slow = jnp.where(accepted, jnp.where(~first & (-change < tolerance * state.cost), state.slow + 1, 0), state.slow)
    cost, ended = jnp.where(accepted, cost, state.cost), state.last | (slow >= SLOW)
    return accepted, state._replace(cost=cost, damping=damping, steps=state.steps + 1, slow=slow, converged=ended)


def aimed(state: State, tried: PyTree, expected: Float[Array, ""], least: Float[Array, ""] | float = 0.0) -> State:
    """Set the next point to try; it is the last one if the expected decrease is below `least` or rounding.

    If the expected decrease is small only because failed steps raised the damping, the fit continues until it stalls.
    """
    hidden = HIDDEN * jnp.finfo(state.cost.dtype).eps * state.cost
    promised = expected * jnp.maximum(state.damping, 1)
    last = (expected <= jnp.maximum(least, hidden)) & (promised <= jnp.maximum(100 * least, PROMISED * state.cost))
    return state._replace(tried=tried, expected=expected, last=last)


def minimise(
    evaluate: Callable[[PyTree, State], tuple[Float[Array, ""], PyTree]],
    aim: Callable[[PyTree, Float[Array, ""]], tuple[PyTree, Float[Array, ""], Float[Array, ""] | float]],
    state: State,
    max_steps: int,
    tolerance: float = 0.0,
    loop=jax.lax.while_loop,
) -> State:
    """Try points, at most `max_steps`, until one is the last.

    `evaluate(point, state)` returns the cost and other results at a point. `aim(results, damping)` returns the next
    point, the expected decrease and the smallest useful one. `loop` should be `in_python` outside compiled programs.
    """

    def step(state: State) -> State:
        cost, found = evaluate(state.tried, state)
        accepted, state = judged(state, cost, tolerance)
        best = jax.tree.map(partial(jnp.where, accepted), found, state.best)
        return aimed(state._replace(best=best), *aim(best, state.damping))

    return loop(lambda state: state.running & (state.steps < max_steps), step, state)


def corrected(
    cost_and_errors: Callable[[Array], tuple[Float[Array, ""], Array]],
    correction: Callable[[Array, Array], Array],
    tried: Float[Array, " p"],
) -> tuple[Float[Array, " p"], Float[Array, ""]]:
    """Return the better of a point and that point with a second-order correction, and its cost.

    `correction` returns a step that reduces errors which the linear model missed. In curved valleys this follows the
    bend, like geodesic acceleration (Transtrum and Sethna 2012).
    """

    def attempt(carry, _):
        z, best, least = carry
        cost, errors = cost_and_errors(z)
        better = cost < least
        return (z + correction(z, errors), jnp.where(better, z, best), jnp.where(better, cost, least)), None

    return jax.lax.scan(attempt, (tried, tried, jnp.full((), jnp.inf)), length=2)[0][1:]


def in_python(running: Callable[[State], Bool[Array, ""]], step: Callable[[State], State], state: State) -> State:
    while running(state):
        state = step(state)
    return state


def move_of_rows(
    jacobian: Float[Array, "s p"], r: Float[Array, " s"], damping: Float[Array, ""]
) -> tuple[*Move, Float[Array, "p p"]]:
    """Minimise ‖J δ + r‖² + damping ‖δ‖² by QR: JᵀJ would square the condition number. Also return the triangle."""
    p = jacobian.shape[1]
    rows = jnp.concatenate([jacobian, r[:, None]], axis=1)
    upper = jnp.linalg.qr(jnp.concatenate([rows, jnp.sqrt(damping) * jnp.eye(p, p + 1)]), mode="r")
    move = -jax.scipy.linalg.solve_triangular(upper[:p, :p], upper[:p, p])
    return move, jnp.sum(jnp.square(upper[:p, p])) + damping * move @ move, upper[:p, :p]


def move_of_equations(gram: Float[Array, "p p"], score: Float[Array, " p"], damping: Float[Array, ""]) -> Move:
    """Minimise the same from JᵀJ and Jᵀr, with parameters scaled to unit effect; one without effect does not change."""
    size = jnp.sqrt(jnp.diagonal(gram))
    seen = size > 0
    unit = jnp.where(seen, 1 / jnp.where(seen, size, 1), 0)
    held = gram * unit[:, None] * unit + jnp.diag(jnp.where(seen, damping, 1.0))
    move = -solve(held, score * unit)
    return move * unit, damping * move @ move - move @ (score * unit)
