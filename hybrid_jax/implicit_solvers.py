"""Implicit solvers of diffrax with fixed steps: their stages' equations, and what is said where these have no root."""

import dataclasses
from collections.abc import Iterator
from contextlib import contextmanager

import diffrax
import equinox as eqx
import jax.numpy as jnp
import optimistix

RESULTS = optimistix.RESULTS
STEPS = 50  # of Newton's method in a stage
ROUNDED = 4  # times the rounding of the largest state: a smaller update of any state is none


class Newton(optimistix.Newton):
    """Newton's method in a stage of an implicit solver, from the state at the start of the step, until that is solved.

    Diffrax begins with the slope of the earlier stage, which off a slow manifold is far away, and ends at the first
    update that grows. Here an update counts by what it does to the state (Hairer and Wanner 1996, Sec. IV.8): how large
    a slope is says nothing where it is the difference of large terms.
    """

    def step(self, fn, y, args, options, state, tags):
        *_, partial, (_, start), control = args
        per = args[1] * (1 if len(args) == 7 else control)  # the state's change per unit of y, an increment or a slope
        # It is 0 in an explicit stage.
        y = jnp.where((state.step == 0) & (per != 0), (start - partial) / jnp.where(per == 0, 1, per), y)
        before, (y, state, aux) = y, super().step(fn, y, args, options, state, tags)
        # A root that is not finite would end the program where it is differentiated.
        finite = jnp.isfinite(y).all()
        y, result = jnp.where(finite, y, before), RESULTS.where(finite, state.result, RESULTS.nonlinear_divergence)
        size = jnp.abs(start) + jnp.abs(partial + per * y)
        # Off a slow manifold the earlier stages move far, and the last digits of where they end are lost.
        size = self.rtol * size + ROUNDED * jnp.finfo(size.dtype).eps * jnp.max(size + jnp.abs(partial))
        change = jnp.max(jnp.abs(per * state.diff) / jnp.where(size > 0, size, 1))
        return y, eqx.tree_at(lambda state: (state.diffsize, state.result), state, (change, result)), aux

    def terminate(self, fn, y, args, options, state, tags):
        return (state.diffsize < 1) | (state.result != RESULTS.successful), state.result


def prepared(solver: diffrax.AbstractSolver, dtype) -> diffrax.AbstractSolver:
    """The solver with a root finder that converges and a bounded loop, which `shard_map` can differentiate."""
    if isinstance(solver, diffrax.HalfSolver):
        return eqx.tree_at(lambda half: half.solver, solver, prepared(solver.solver, dtype))
    if isinstance(solver, diffrax.AbstractImplicitSolver) and not isinstance(solver.root_finder.rtol, float):  # pyright: ignore[reportAttributeAccessIssue]
        tolerance = 1e-5 if jnp.finfo(dtype).bits < 64 else 1e-10
        # A step here is a whole interval, and is not tried again with a smaller one as diffrax's default expects.
        newton = Newton(tolerance, tolerance, cauchy_termination=False)
        solver = dataclasses.replace(solver, root_finder=newton, root_find_max_steps=STEPS)
    if isinstance(solver, diffrax.AbstractRungeKutta) and solver.scan_kind is None:
        return dataclasses.replace(solver, scan_kind="bounded")
    return solver


@contextmanager
def solver_errors(solver: diffrax.AbstractSolver | None) -> Iterator[None]:
    """Shorten the message of an implicit solver whose equations are not finite to one line."""
    try:
        yield
    except eqx.EquinoxRuntimeError:
        raise unsolved(solver) from None


def unsolved(solver: diffrax.AbstractSolver | None) -> ValueError:
    remedy = "use windows with a smaller dt, a better first guess, or a bounded field"
    return ValueError(f"solver: {type(solver).__name__} cannot solve a step of a trial model; {remedy}")
