"""Implicit solvers of diffrax with fixed steps: solve the equations of their stages, and report if they cannot."""

import dataclasses
from collections.abc import Iterator
from contextlib import contextmanager

import diffrax
import equinox as eqx
import jax.numpy as jnp
import optimistix

RESULTS = optimistix.RESULTS
STEPS = 50  # of Newton's method in a stage
ROUNDED = 4  # times the rounding of the largest state: updates below this are zero


class Newton(optimistix.Newton):
    """Newton's method for a stage of an implicit solver, starting from the state at the start of the step.

    Diffrax starts from the slope of the previous stage, which is a bad guess off a slow manifold, and stops at the
    first update that grows. Here, instead, the method stops when the state no longer changes (Hairer and Wanner 1996,
    Sec. IV.8), since the size of a slope means nothing if it is the difference of large terms.
    """

    def step(self, fn, y, args, options, state, tags):
        *_, partial, (_, start), control = args
        per = args[1] * (1 if len(args) == 7 else control)  # the state's change per unit of y, an increment or a slope
        # `per` is 0 in an explicit stage.
        y = jnp.where((state.step == 0) & (per != 0), (start - partial) / jnp.where(per == 0, 1, per), y)
        before, (y, state, aux) = y, super().step(fn, y, args, options, state, tags)
        # To differentiate a root that is not finite would end the program.
        finite = jnp.isfinite(y).all()
        y, result = jnp.where(finite, y, before), RESULTS.where(finite, state.result, RESULTS.nonlinear_divergence)
        size = jnp.abs(start) + jnp.abs(partial + per * y)
        # Off a slow manifold the earlier stages move far, so the last digits of their sum are lost.
        size = self.rtol * size + ROUNDED * jnp.finfo(size.dtype).eps * jnp.max(size + jnp.abs(partial))
        change = jnp.max(jnp.abs(per * state.diff) / jnp.where(size > 0, size, 1))
        return y, eqx.tree_at(lambda state: (state.diffsize, state.result), state, (change, result)), aux

    def terminate(self, fn, y, args, options, state, tags):
        return (state.diffsize < 1) | (state.result != RESULTS.successful), state.result


def prepared(solver: diffrax.AbstractSolver, dtype) -> diffrax.AbstractSolver:
    """Return the solver with a root finder that converges and a bounded loop, which `shard_map` can differentiate."""
    if isinstance(solver, diffrax.HalfSolver):
        return eqx.tree_at(lambda half: half.solver, solver, prepared(solver.solver, dtype))
    if isinstance(solver, diffrax.AbstractImplicitSolver) and not isinstance(solver.root_finder.rtol, float):  # pyright: ignore[reportAttributeAccessIssue]
        tolerance = 1e-5 if jnp.finfo(dtype).bits < 64 else 1e-10
        # A step is never repeated with a smaller one, as diffrax's default root finder expects.
        newton = Newton(tolerance, tolerance, cauchy_termination=False)
        solver = dataclasses.replace(solver, root_finder=newton, root_find_max_steps=STEPS)
    if isinstance(solver, diffrax.AbstractRungeKutta) and solver.scan_kind is None:
        return dataclasses.replace(solver, scan_kind="bounded")
    return solver


@contextmanager
def solver_errors(solver: diffrax.AbstractSolver | None) -> Iterator[None]:
    """If the equations of an implicit solver are not finite, raise an error of one line instead of Equinox's."""
    try:
        yield
    except eqx.EquinoxRuntimeError:
        raise unsolved(solver) from None


def unsolved(solver: diffrax.AbstractSolver | None) -> ValueError:
    remedy = "use windows with a smaller dt, a better first guess, or a bounded field"
    return ValueError(f"solver: {type(solver).__name__} cannot solve a step of a trial model; {remedy}")
