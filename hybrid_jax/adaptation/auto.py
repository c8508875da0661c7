"""Adaptation by the method that the windows themselves ask for."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from hybrid_jax import checks
from hybrid_jax.adaptation.anchored import fit_anchored, with_change
from hybrid_jax.adaptation.methods import Method, Solution, scale_of
from hybrid_jax.adaptation.plausible import Plausible, groups_of
from hybrid_jax.adaptation.selection import BLOCKS, BlockErrors, blocks_of, fit_candidates, simplest
from hybrid_jax.adaptation.support import Errors, Unchanged, alike, errors_of, unchanged
from hybrid_jax.dynamics.base import AbstractVectorField, trainable
from hybrid_jax.dynamics.composition import Hybrid
from hybrid_jax.dynamics.disturbance import physics_of, sized, with_disturbance
from hybrid_jax.dynamics.rigid_body import corrected
from hybrid_jax.estimation.least_squares import Scale, Solver, ravel_parameters
from hybrid_jax.estimation.uncertainty import named_parameters
from hybrid_jax.runtime import FASTEST_COMPILE, jit_with
from hybrid_jax.status import ended
from hybrid_jax.training.objective import Settings
from hybrid_jax.trajectories import Trajectories

# What each candidate fits, as groups of parameters. Those apply of which the field has all groups.
CANDIDATES: Mapping[str, tuple[str, ...]] = {
    "source": (),
    "theta": ("theta",),
    "disturbance": ("theta", "disturbance"),
    "force": ("theta", "force"),
    "drag": ("theta", "drag"),
    "efficiency": ("theta", "efficiency"),
    "force_torque": ("theta", "force", "torque"),
    "force_drag": ("theta", "force", "drag"),
    "force_efficiency": ("theta", "force", "efficiency"),
    "force_torque_drag": ("theta", "force", "torque", "drag"),
    "all": ("theta", "force", "torque", "drag", "efficiency"),
}
PLAUSIBLE = Plausible()
NETWORK = "network"  # the candidate that changes the network
CONFOUNDED = ("k", "k_rotors")  # with the rotors' efficiencies


class Choice(NamedTuple):
    """c candidates, and which one was taken.

    Attributes:
        names: of the candidates.
        errors: of each candidate on each of b blocks that were left out (c, b).
        taken: the index of the candidate that was taken.
        supported: which candidates explain more than an error of the source would let them, see `support` (c,).
        parameters: names of the p parameters of the extended physics, see `extended`.
        free: which of these each candidate fitted (c, p).
        theta: their values in each candidate, in the physics' own parametrisation (c, p).
        change: of the network's weights in each candidate (c, w); None if the network may not change, or there is none.
    """

    names: tuple[str, ...]
    errors: BlockErrors
    taken: Int[Array, ""]
    supported: Bool[Array, " c"]
    parameters: tuple[str, ...]
    free: Bool[Array, "c p"]
    theta: Float[Array, "c p"]
    change: Float[Array, "c w"] | None


@dataclass(frozen=True)
class Auto(Method):
    """The simplest of several methods that predicts left-out windows as well as the best; see `selection`.

    Of a rigid body: the source as it is; θ_p; with them steady forces and torques, drag and the rotors' efficiencies.
    Of another system: the source, θ_p, θ_p and a constant disturbance. Then, starting from the one that was taken, the
    network, held at the source's weights.

    Attributes:
        networks: whether the network may change.
        blocks: how many blocks of windows are left out in turn.
        max_steps: the most steps of each fit.
        plausible: how far the changed system plausibly is from the source.
    """

    networks: bool = True
    blocks: int = BLOCKS
    max_steps: int = 100
    plausible: Plausible = PLAUSIBLE
    uses_validation: ClassVar[bool] = False
    has_intervals: ClassVar[bool] = True
    uses_motion: ClassVar[bool] = True

    def solve(self, field, train, validation, settings: Settings, learned_from: Trajectories | None = None) -> Solution:
        """See `Method.solve`.

        Args:
            learned_from: windows that the source was trained on; without any, or if traced, nothing is refused.
        """
        jax.eval_shape(lambda: ravel_parameters(field)[0])  # refuses physics without parameters
        traced = any(map(checks.is_traced, jax.tree.leaves((field, train))))  # then the outer program has the options
        # Of the settings these alone matter; as an array, another scale asks for no other program.
        scale, solver = scale_of(settings.objective, train.x0.shape[-1]), settings.solver
        found = (errors_of if traced else _errors_of)(field, train, solver, scale)
        expected = Unchanged(-jnp.ones(()), jnp.ones(()))  # supports everything
        if learned_from is not None and not traced:
            own = _errors_of(field, alike(learned_from, train), solver, scale)
            expected = unchanged(field, train, found, own, learned_from)
        return (Auto._solution if traced else _compiled)(self, field, train, solver, scale, found, expected)

    def _solution(
        self, field, train: Trajectories, solver: Solver, scale: Scale, found: Errors, expected: Unchanged
    ) -> Solution:
        n, d = train.x0.shape
        starts, noise = found.starts, found.noise
        larger = extended(field, d)
        fitted = free_parameters(larger)
        left = n - blocks_of(n, self.blocks)[0].shape[1]  # windows that fit a block's prediction
        fitted = {name: free for name, free in fitted.items() if name == "source" or free.sum() < left}
        free, sizes = np.stack([*fitted.values()]), np.array([each.sum() for each in fitted.values()])
        held = jnp.sqrt(noise) / self.plausible.sizes(larger, train)
        fits = fit_candidates(larger, train, free, solver, self.max_steps, scale, self.blocks, starts, held)
        supported = expected.supports(fits.mse[0] - fits.mse, sizes).at[0].set(True)
        own = taken_of(fits.errors, supported, sizes)
        parameters = (*named_parameters(larger),)
        choice = Choice((*fitted,), fits.errors, own, supported, parameters, jnp.asarray(free), fits.theta, None)
        if self.networks and has_network(larger):
            choice = _with_network(larger, choice, sizes, train, solver, scale, self.blocks, starts, expected)
        status = ended(fits.converged[own], fits.converged[own] | jnp.isfinite(fits.errors.mse[own]).all())
        return Solution(candidate(larger, choice, choice.taken), fits.steps[own], status, choice)


_compiled, _errors_of = jit_with(FASTEST_COMPILE)(Auto._solution), jit_with(FASTEST_COMPILE)(errors_of)


def taken_of(errors: BlockErrors, supported: Bool[Array, " c"], sizes: np.ndarray) -> Int[Array, ""]:
    """The simplest candidate near the best, of those that are supported."""
    return simplest(jnp.where(supported[:, None], errors.mse, jnp.inf), sizes)


def candidate(larger: AbstractVectorField, choice: Choice, index: Int[Array, ""] | int) -> AbstractVectorField:
    """The field of a candidate, from the extended source."""
    adapted = ravel_parameters(larger)[1](choice.theta[index])
    return adapted if choice.change is None else with_change(adapted, choice.change[index])  # type: ignore


def extended(field: AbstractVectorField, d: int) -> AbstractVectorField:
    """The field with all parameters that a candidate may fit, at values that change nothing."""
    return sized(with_disturbance(corrected(field)), d)


def free_parameters(field: AbstractVectorField) -> dict[str, np.ndarray]:
    """For each candidate, which of the parameters of an extended field it fits (p,)."""
    names = [*named_parameters(field)]
    group = groups_of(names)
    lost = np.array([name.split("[")[0] in CONFOUNDED for name in names])
    found = {}
    for name, fitted in CANDIDATES.items():
        if set(fitted) <= {*group, "theta"}:
            free = np.array([each in fitted for each in group])
            found[name] = free & ~lost if "efficiency" in fitted else free
    return found


def has_network(field: AbstractVectorField) -> bool:
    """Whether a field is a hybrid whose residual is not a disturbance, and can be trained."""
    return (
        isinstance(field, Hybrid) and physics_of(field) is not field and any(jax.tree.leaves(trainable(field.residual)))
    )


def _with_network(
    larger, choice: Choice, sizes: np.ndarray, windows, solver, scale, blocks, starts, expected: Unchanged
) -> Choice:
    """The choice with one more candidate: the one taken so far with its network changed."""
    steps = fit_anchored(candidate(larger, choice, choice.taken), windows, solver, scale, blocks=blocks, starts=starts)
    # Penalties are in the order of their strength, so that the first of several as good changes least.
    best = simplest(steps.errors.mse, np.arange(len(steps.removed)))
    steps = jax.tree.map(lambda leaf: leaf[best][None], steps)
    errors = jax.tree.map(lambda *both: jnp.concatenate(both), choice.errors, steps.errors)
    supported = jnp.concatenate([choice.supported, expected.supports(steps.removed, steps.fitted)])
    zeros = jnp.zeros((len(choice.names), steps.changes.shape[1]), steps.changes.dtype)

    def repeated(values):
        return jnp.concatenate([values, values[choice.taken][None]])

    return Choice(
        (*choice.names, NETWORK),
        errors,
        taken_of(errors, supported, np.append(sizes, sizes.max() + 1)),
        supported,
        choice.parameters,
        repeated(choice.free),
        repeated(choice.theta),
        jnp.concatenate([zeros, steps.changes]),
    )
