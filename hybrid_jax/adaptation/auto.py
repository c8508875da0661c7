"""Adaptation that chooses the most probable change, see `Auto`."""

from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from hybrid_jax import checks
from hybrid_jax.adaptation import anchored, evidence, selection
from hybrid_jax.adaptation.evidence import Posterior
from hybrid_jax.adaptation.expectation import errors_of_units, no_higher, parts_of_flights
from hybrid_jax.adaptation.methods import Method, Solution, scale_of
from hybrid_jax.adaptation.plausible import Plausible, extended, free_parameters, groups_of, kept_parameters, names_of
from hybrid_jax.adaptation.results import NETWORK, Choice
from hybrid_jax.adaptation.selection import Fit, Unchanged
from hybrid_jax.adaptation.source import OfSource, fit_pair, judge_source
from hybrid_jax.dynamics.base import AbstractVectorField
from hybrid_jax.estimation.least_squares import Scale, ravel_parameters
from hybrid_jax.estimation.normal_equations import masked
from hybrid_jax.networks.standardise import motion_of
from hybrid_jax.runtime import FASTEST_COMPILE, UNOPTIMISED, jit_by_size
from hybrid_jax.status import Status
from hybrid_jax.training.objective import Settings
from hybrid_jax.trajectories import Trajectories

PLAUSIBLE = Plausible()
VAGUE = 1 / 3  # of a plausible change: if the network may have absorbed more, a parameter is called effective
SIMILAR = 2.0  # factor between variances of noise up to which errors of the source and of this flight are comparable
ROUNDS = 2  # the second linearises at the first's result: squared errors are not quadratic over large changes


@dataclass(frozen=True)
class Auto(Method):
    """Choose the most probable of several changes; see `evidence`.

    The candidates for a rigid body are no change, new θ_p, and new θ_p with constant forces and torques, wind, drag,
    rotor efficiencies and a load, each with the aerodynamic coefficients of θ_p held or free; for other systems no
    change, new θ_p, and new θ_p with a constant disturbance. A change must also predict left-out blocks of windows
    better. A penalised change of the network's weights is then tried on top. If physics without the network predicts
    the source's own motion better, it replaces the source.

    Attributes:
        parameters: whether parameters may change.
        networks: whether the network may change.
        blocks: number of blocks of windows that are left out in turn to estimate the expected errors.
        max_steps: maximum number of steps of each fit.
        plausible: prior standard deviations of the changes.
    """

    parameters: bool = True
    networks: bool = True
    blocks: int = selection.BLOCKS
    max_steps: int = 100
    plausible: Plausible = PLAUSIBLE
    uses_validation: ClassVar[bool] = False
    has_intervals: ClassVar[bool] = True
    uses_motion: ClassVar[bool] = True

    def solve(
        self,
        field,
        train,
        validation,
        settings: Settings,
        learned_from: Trajectories | None = None,
        flights: Int[np.ndarray, " n"] | None = None,
    ) -> Solution:
        """See `Method.solve`.

        Args:
            learned_from: windows that the source was trained on, by default those that it stores; without them its
                network is assumed to err by a fifth of its effect (`selection.ERRING`). If they follow each other, they
                also tell how much errors differ between flights, see `expectation.expected_errors`.
            flights: the flight of each window (n,), if there are several: expected errors then come from left-out
                flights instead of blocks.
        """
        jax.eval_shape(lambda: ravel_parameters(field)[0])  # raises without parameters
        traced = any(map(checks.is_traced, jax.tree.leaves((field, train))))
        # Only these settings matter. The scale is an array, so that another value does not compile again.
        scale, solver = scale_of(settings.objective), settings.solver
        larger, physics, sizes = _begin(self, field, train)
        whole = larger  # which physics without the network may replace
        options, effect, step, score = (sizes, solver, scale, self.max_steps), None, None, None
        quantities = anchored.quantities_of(larger, train)
        still, network = np.zeros(sizes.shape, sizes.dtype), anchored.has_network(field)
        both, source = np.outer([0, 1], np.ones(len(names_of(larger)))) > 0, None  # fit nothing, and everything
        learned_from = motion_of(field) if learned_from is None else learned_from
        shares = None if learned_from is None else _shares(field, learned_from, train)
        known = None if traced or flights is not None else learned_from  # several flights need no others
        if learned_from is not None:
            larger, source = judge_source(larger, physics, learned_from, train, options, self.blocks, self.networks)
            learned_from = selection.alike(learned_from, train)
        options = *options, jnp.array(len(train))
        (found, every, starts), fitted = first, _ = fit_pair(larger, still, train, both, *options), None
        for _ in range(ROUNDS):
            if network:  # even if physics replaced the source: the effect is the difference of the two models
                effect = anchored.network_effect(whole, train, starts, solver, scale)
            given = source, quantities, learned_from, shares, effect
            chosen, nothing, move, rows = _judge(larger, found, every, *given, sizes)
            if traced or fitted is None or not np.array_equal(rows, fitted):
                options = chosen.sizes, *options[1:]
                (_, found, starts), fitted = fit_pair(larger, move, train, rows, *options), rows
                if not traced and int(found.status) == Status.DIVERGED:
                    _, found, starts = fit_pair(larger, still, train, rows, *options)
        rival, move, rows = evidence.rival(larger, every, chosen)
        if traced or int(rival) != int(chosen.taken):
            fits = (found, starts), fit_pair(larger, move, train, rows, *options)[1:]
            (found, starts), chosen = evidence.better(larger, every, fits, chosen, rival, nothing, sizes)
        units = selection.blocks_of(len(train), self.blocks, flights)
        weights = anchored.weights_of(larger)[0].size if network else 0

        def ends_of(thetas, change: Array | None = None, windows: Trajectories = train) -> Array:
            change = jnp.zeros((len(thetas), weights)) if change is None else change
            return errors_of_units(larger, thetas, change, windows, units, solver)

        sure, left_out = _left_out(self, larger, found, first[0], chosen, None if flights is None else units)
        same = jnp.broadcast_to(ravel_parameters(larger)[0], left_out.shape)
        fits = (found, starts, left_out, ends_of(left_out)), (first[0], first[2], same, ends_of(same))
        (found, starts, left_out, ends), chosen = _confirm(sure, *fits, chosen, scale)
        if self.networks and network:
            step = _fit_network(self, _anchor(larger, train, starts, found, solver, scale), found, nothing, units)
            step, ends = _confirm_network(step, ends, ends_of(left_out, step.left_out), source, scale)
        if network:
            at = ravel_parameters(larger)[1](found.theta.astype(sizes.dtype))
            score = anchored.network_effect(at, train, starts, solver, scale).score
        alike = units if traced or selection.correlated(train) > 1 else selection.blocks_of(len(train), len(train))
        outcome = found, chosen, ends, source, nothing, score, step
        solution = _conclude(field, larger, train, outcome, alike, sizes)
        if known is None or source is None or not 1 / SIMILAR < float(found.noise / source.own.noise) < SIMILAR:
            return solution
        parts = (selection.alike(known[part], train) for part in parts_of_flights(known, train))
        usual = [jnp.mean(ends_of(same, windows=part), axis=0) for part in parts]
        return solution._replace(choice=solution.choice._replace(usual=jnp.stack(usual) if usual else None))


_shares = jit_by_size(UNOPTIMISED)(selection.shares_outside)


@jit_by_size(UNOPTIMISED)
def _begin(method: Auto, field, train: Trajectories):
    larger = extended(field, train.x0.shape[1])
    physics = anchored.without_network(larger) if anchored.has_network(larger) else None
    return larger, physics, method.plausible.sizes(larger, train)


@jit_by_size(UNOPTIMISED)
def _judge(
    larger, around: Fit, every: Fit, source: OfSource | None, quantities: int, learned_from, shares, effect, sizes
) -> tuple[Posterior, Unchanged, Float[Array, " p"], Bool[Array, "2 p"]]:
    start = ravel_parameters(larger)[0]
    free, added = np.stack([*free_parameters(larger).values()]), effect.total if effect else 0.0
    own = None if source is None else source.own
    nothing = selection.unchanged(own, around, added, quantities, learned_from, shares)
    # A source may err in its force and drag; a wind, which could explain the same errors again, is not its own.
    air = np.isin(groups_of(names_of(larger)), ("wind", "updraft"))
    nothing = nothing._replace(apparent=jnp.where(air, 0.0, nothing.apparent))
    found = evidence.posterior(around, every, start, free, sizes, nothing.apparent)
    return found, nothing, *evidence.to_fit(larger, every, found.taken)


@jit_by_size(UNOPTIMISED)
def _left_out(
    method: Auto, larger, changed: Fit, still: Fit, chosen: Posterior, units
) -> tuple[Bool[Array, ""], Array]:
    """Return whether left-out blocks confirm the change, and the parameters without each block, or each of `units`."""
    free, start = jnp.stack([*free_parameters(larger).values()])[chosen.taken], ravel_parameters(larger)[0]
    blocks = selection.blocks_of(len(still.equations.score), method.blocks)
    thetas = selection.left_out_thetas(changed, free, chosen.sizes, start, blocks)
    sure = selection.surely_lower(changed, still, thetas, blocks) & method.parameters
    return sure, thetas if units is None else selection.left_out_thetas(changed, free, chosen.sizes, start, units)


@jit_by_size(UNOPTIMISED)
def _confirm(
    sure: Bool[Array, ""], changed: tuple, still: tuple, chosen: Posterior, scale: Scale
) -> tuple[Any, Posterior]:
    """Return the chosen change or, if left-out blocks do not confirm it, no change."""
    sure = (chosen.taken == 0) | sure & no_higher(changed[-1], still[-1], scale)
    changed = jax.tree.map(partial(jnp.where, sure), changed, still)
    return changed, chosen._replace(taken=jnp.where(sure, chosen.taken, 0))


@jit_by_size(FASTEST_COMPILE)
def _anchor(larger, train: Trajectories, starts, found: Fit, solver, scale) -> anchored.Subspace:
    """Linearise the errors in the network's weights at the chosen candidate."""
    return anchored.subspace(ravel_parameters(larger)[1](found.theta), train, starts, solver, scale)


@jit_by_size(UNOPTIMISED)
def _fit_network(method: Auto, found: anchored.Subspace, at: Fit, nothing: Unchanged, units) -> anchored.Anchored:
    blocks = selection.blocks_of(len(at.equations.score), method.blocks)
    return anchored.fit_anchored(found, at.noise, nothing.error, blocks, units)


@jit_by_size(UNOPTIMISED)
def _confirm_network(
    step: anchored.Anchored, ends, changed, source: OfSource | None, scale: Scale
) -> tuple[Any, Array]:
    """Set the odds of the network's change to 0 if left-out units do not confirm it; also return the errors."""
    sure = no_higher(changed, ends, scale)
    sure = sure if source is None else sure & ~source.alone
    step = step._replace(odds=jnp.where(sure, step.odds, 0.0))
    return step, jnp.where(step.odds > evidence.STRONG, changed, ends)


@jit_by_size(UNOPTIMISED)
def _conclude(field, larger, train: Trajectories, outcome, blocks, sizes) -> Solution:
    """Summarise the outcome, with the variances that the source and its network add."""
    found, chosen, ends, source, nothing, score, step = outcome
    start = ravel_parameters(larger)[0]
    names, free = zip(*free_parameters(larger).items(), strict=True)
    free, taken, change = jnp.stack(free), chosen.taken, None
    theta = chosen.theta.at[taken].set(found.theta)
    probability, rejected = chosen.probability, chosen.naive > chosen.naive[taken]
    fitted = free[taken] & found.seen
    kept = jnp.asarray(kept_parameters(larger))[taken]
    alone, of_source, degrees = jnp.array(False), jnp.diag(nothing.apparent), jnp.inf
    if source is not None:
        _, alone, covariance, degrees = source
        of_source = jnp.where(alone, covariance, of_source)
    inherited = selection.spread(found.equations, fitted, of_source)
    inherited = inherited + jnp.diag(jnp.where(kept, jnp.diagonal(of_source), 0.0))
    if step is not None:
        removed = anchored.weights_of(larger)[0] - anchored.weights_of(field)[0]  # all, if physics replaced it
        better = step.odds > evidence.STRONG
        change = jnp.tile(removed, (len(names) + 1, 1)).at[-1].add(step.change)
        probability = jnp.append(probability, step.odds / (1 + step.odds))
        rejected = jnp.append(rejected, (step.naive > evidence.STRONG) & ~better & ~alone)
        free, theta = (jnp.concatenate([each, each[taken][None]]) for each in (free, theta))
        names, taken = (*names, NETWORK), jnp.where(better, len(names), taken)
    absorbed = jnp.zeros_like(start)
    if score is not None:

        def taken_over(free: Bool[Array, " p"]) -> Float[Array, " p"]:
            return anchored.taken_by_network(masked(found.equations, free), jnp.where(free, score, 0.0), blocks)

        of_fitted, of_kept = jax.lax.map(taken_over, jnp.stack([fitted, fitted | kept & found.seen]))
        absorbed = jnp.where(~alone, jnp.where(kept, of_kept, of_fitted), absorbed)
    # Only rigid bodies: other systems' sizes are relative to the source's value and depend on the parametrisation.
    vague = jnp.sqrt(absorbed) > VAGUE * (sizes if "drag" in groups_of(names_of(larger)) else jnp.inf)
    first = names, probability, rejected, taken, alone, (*names_of(larger),), free, kept, theta
    choice = Choice(*first, found.equations, change, ends, inherited, jnp.asarray(degrees), absorbed, vague)
    adapted = candidate(extended(field, train.x0.shape[1]), choice, taken)
    status = jnp.where(jnp.any(found.seen), found.status, Status.STALLED)  # no parameter has an effect
    finite = (status == Status.OK) | ~jnp.isinf(ends).any()
    return Solution(adapted, found.steps, jnp.where(finite, status, Status.DIVERGED), choice)


def candidate(larger: AbstractVectorField, choice: Choice, index: Int[Array, ""] | int) -> AbstractVectorField:
    adapted = ravel_parameters(larger)[1](choice.theta[index])
    return adapted if choice.change is None else anchored.with_change(adapted, choice.change[index])  # type: ignore
