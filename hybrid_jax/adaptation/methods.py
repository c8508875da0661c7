"""Methods of adaptation: values that turn a source field and target windows into an adapted field."""

from dataclasses import dataclass, replace
from functools import cache
from typing import Any, ClassVar, Literal, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Int, PyTree

from hybrid_jax import checks
from hybrid_jax.adaptation import ridge
from hybrid_jax.dynamics.base import AbstractVectorField, trainable
from hybrid_jax.dynamics.composition import Frozen, Hybrid
from hybrid_jax.dynamics.disturbance import sized, with_disturbance
from hybrid_jax.estimation.least_squares import Scale, fit_free, ravel_parameters
from hybrid_jax.estimation.uncertainty import check_determined, select_disturbance
from hybrid_jax.runtime import jit_by_size
from hybrid_jax.status import Status
from hybrid_jax.training.fitting import ADAM, make_run_config, run, start
from hybrid_jax.training.objective import Objective, Settings, TrajectoryLoss
from hybrid_jax.trajectories import Trajectories


class Solution(NamedTuple):
    """The result of a method of adaptation.

    Attributes:
        field: the adapted field.
        steps: number of epochs, or of evaluations of the Jacobian; 0 for a closed form.
        status: how the method ended.
        choice: the candidates of `Auto` and the chosen one, a `results.Choice`; None for another method.
    """

    field: AbstractVectorField
    steps: Int[Array, ""] | int = 0
    status: Int[Array, ""] | int = Status.OK
    choice: Any = None


class Method(Protocol):
    """A method of adaptation: any object with `solve`, for example a frozen dataclass of hyper-parameters.

        @dataclass(frozen=True)
        class BestOf:
            candidates: tuple[AbstractVectorField, ...]

            def solve(self, field, train, validation, settings):
                return Solution(min(self.candidates, key=lambda one: rollout_mse(one, validation)))

    Two class attributes are optional. `uses_validation = False` keeps all windows for training. You should set
    `has_intervals = True` only if the method minimises L_MSE over the physics' parameters and nothing else, since
    intervals are valid only then.
    """

    def solve(
        self, field: AbstractVectorField, train: Trajectories, validation: Trajectories, settings: Settings
    ) -> Solution:
        """Adapt a field. You can use the library's methods under `jit`, and under `vmap` over stacked fields.

        Args:
            field: the source field, which must not be changed.
            train: windows of the changed system to adapt to. NaN in x means "not measured", also in place of outliers.
            validation: other windows of the changed system, for early stopping and choices.
            settings: the objective and the solver; for training also minibatches and regulariser.

        Raises:
            ValueError: if the method cannot use the field, windows or settings.
        """
        ...


@dataclass(frozen=True)
class LeastSquares(Method):
    """Fit θ_p and a constant disturbance by least squares; the residual does not change.

    Attributes:
        disturbance: whether to fit a disturbance; "auto" fits one if the windows need it, see `select_disturbance`.
        indices: the disturbed states, see `with_disturbance`.
        max_steps: maximum number of steps of each fit.
    """

    disturbance: Literal["auto"] | bool = "auto"
    indices: tuple[int, ...] | None = None
    max_steps: int = 100
    uses_validation: ClassVar[bool] = False
    has_intervals: ClassVar[bool] = True

    def __post_init__(self):
        if self.disturbance not in ("auto", True, False):
            raise ValueError(f"disturbance must be 'auto', True or False, got {self.disturbance!r}")
        if self.indices is not None:
            checks.places("indices", self.indices)

    def solve(self, field, train: Trajectories, validation: Trajectories, settings: Settings) -> Solution:
        n, d = train.x0.shape
        options = {"solver": settings.solver, "max_steps": self.max_steps, "scale": scale_of(settings.objective)}
        indices = None if self.indices is None else checks.places("indices", self.indices, d)
        larger = sized(with_disturbance(field, indices), d)
        start = larger if self.disturbance is True else field
        check_determined(start, n)
        if self.disturbance == "auto" and n > ravel_parameters(larger)[0].size:  # enough to decide
            found = select_disturbance(field, train, indices=indices, **options).fit
        else:
            found = fit_free(sized(start, d), train, **options)
        return Solution(found.field, found.steps, found.status)


@dataclass(frozen=True)
class FineTune(Method):
    """Fine-tune by Adam from the source's parameters, with early stopping on the validation windows.

    Attributes:
        rates: learning rates, a tree prefix of the field; by default 1e-2 for physics and 1e-3 for the residual.
        frozen: the part that is not trained, or None.
        min_epochs: training does not stop early before this epoch.
        patience: training stops after this many epochs without a better validation loss.
        max_epochs: training stops after this many epochs.
        regulariser_weight: λ of `settings.regulariser`, if there is one.
        l2_sp: weight of half the squared distance from the source's parameters, see `held_at_start`.
        seed: random seed for shuffling minibatches.
    """

    rates: PyTree = None
    frozen: Literal["physics", "residual"] | None = None
    min_epochs: int = 100
    patience: int = 20
    max_epochs: int = 2000
    regulariser_weight: float = 1e-3
    l2_sp: float = 0.0
    seed: int = 0

    def __post_init__(self):
        if self.frozen not in (None, "physics", "residual"):
            raise ValueError(f"frozen must be 'physics', 'residual' or None, got {checks.short_repr(self.frozen)}")
        checks.count("seed", self.seed, least=0)

    def solve(self, field, train: Trajectories, validation: Trajectories, settings: Settings) -> Solution:
        if self.frozen and not isinstance(field, Hybrid):
            raise ValueError(f"field must be a Hybrid to freeze its {self.frozen}, got {type(field).__name__}")
        kept = {self.frozen: getattr(field, self.frozen)} if self.frozen else {}
        marked = replace(field, **{name: Frozen(part) for name, part in kept.items()})
        if not any(jax.tree.leaves(trainable(marked))):
            raise ValueError(f"field: {type(field).__name__} has nothing to train")
        usual = Hybrid(1e-2, 1e-3) if isinstance(field, Hybrid) else 1e-3  # pyright: ignore[reportArgumentType]
        rates, n = usual if self.rates is None else self.rates, len(train)
        rule = self.min_epochs, self.patience, self.max_epochs, self.regulariser_weight
        config = make_run_config(rates, jnp.arange(n), n, *rule)
        settings = replace(settings, batch_size=min(settings.batch_size, n))
        data, held_out = (settings.objective.prepare(windows, "windows") for windows in (train, validation))
        # The default is not an argument: programs with an optimiser's closures are not cached.
        optimiser: dict[str, Any] = {"optimiser": held_at_start(self.l2_sp)} if self.l2_sp else {}
        state = start(marked, jax.random.key(self.seed), **optimiser)
        state, _ = _run(state, config, data, held_out, settings, config.max_epochs, **optimiser)
        return Solution(replace(state.best, **kept), state.epoch, state.status)


_run, _fit_ridge = jit_by_size()(run), jit_by_size()(ridge.fit_ridge)


@cache  # the same object for the same weight, so that its program is compiled once
def held_at_start(weight: float) -> optax.GradientTransformation:
    """Return Adam with the penalty weight / 2 · ‖θ − θ₀‖², θ₀ the initial parameters (L2-SP; Li et al., ICML 2018)."""

    def pull(updates, state, params=None):
        return jax.tree.map(lambda g, p, start: g + weight * (p - start), updates, params, state), state

    return optax.chain(optax.GradientTransformation(lambda params: params, pull), ADAM)


@dataclass(frozen=True)
class Ridge(Method):
    """Fit a linear correction by ridge regression, with the penalty that has the smallest validation error.

    Attributes:
        update: `ridge.last_layer`, `ridge.linear_residual` or a function like them.
        penalties: the penalties to try.
    """

    update: ridge.Update
    penalties: tuple[float, ...] = ridge.PENALTIES

    def solve(self, field, train: Trajectories, validation: Trajectories, settings: Settings) -> Solution:
        ridge.transitions(train)  # raises, before tracing, if no interval tells anything
        return Solution(_fit_ridge(self.update, field, train, validation, self.penalties, settings).field)


@dataclass(frozen=True)
class Source(Method):
    """The baseline: keep the source field."""

    uses_validation: ClassVar[bool] = False

    def solve(self, field, train: Trajectories, validation: Trajectories, settings: Settings) -> Solution:
        return Solution(field)


def scale_of(objective: Objective) -> Scale:
    """Return the error of each state that counts as 1 in the objective; None if each counts in its own unit."""
    if not isinstance(objective, TrajectoryLoss):
        remedy = "or use method='fine_tune', which minimises any objective"
        given = type(objective).__name__
        raise ValueError(f"settings.objective must be a TrajectoryLoss for least squares, got {given}; {remedy}")
    return objective.divisor()
