"""How a model of a real vehicle is trained: stages as data, of source flights and of N windows of the target's."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

from hybrid_jax.training.stages import Stage

Model = Literal["hybrid", "no_physics", "physics_only"]
Physics = Literal["multirotor", "torque_off", "frozen_rates"]
RecipeName = Literal["staged", "turning", "short", "torque_off", "frozen_rates"]

REFERENCE = 1000  # N for which the epochs of an adaptation are given
NETWORK_ALONE = 5e-3  # rate of a network without physics in the steps that are the physics' own


@dataclass(frozen=True)
class Step:
    """One stage of training.

    Attributes:
        physics, residual: Adam's learning rates; a residual of 0 leaves the network as it is.
        steps: intervals of each window that are trained on.
        epochs, patience: the most epochs, and how many without a better validation end the stage.
        kept: names of θ_p that stay as they are.
    """

    physics: float
    residual: float
    steps: int
    epochs: int
    patience: int = 20
    kept: tuple[str, ...] = ()


@dataclass(frozen=True)
class Recipe:
    """A way to train every model.

    Attributes:
        about: what it is, for the report.
        window: intervals of the windows that are cut, validated on, and whose baseline errors weigh the channels.
        source: what is done with plenty of source flights.
        adaptation: what is done with N windows of the target, from the source's model.
        scratch: what is done with N windows of the target, from the nominal vehicle.
        physics: of the hybrid and of physics-only.
        learn: names of `multirotor.SHAPES` in place of the vehicle's own; none keeps those.
        outputs: what a hybrid's network adds to; see `hybrid_jax.networks.factory.make_residual`.
        position: how many times a simple baseline's error in position counts as 1. Position is the integral of velocity
            and says of the motion nothing else; where an estimator's two disagree, it would teach wrong accelerations.
        huber: from how many times a simple baseline's error on an error counts linearly.
    """

    about: str
    window: int
    source: tuple[Step, ...]
    adaptation: tuple[Step, ...]
    scratch: tuple[Step, ...]
    physics: Physics = "multirotor"
    learn: tuple[str, ...] = ()
    outputs: Literal["accelerations", "angular_acceleration", "motion"] = "motion"
    position: float = 1.0
    huber: float = 1.0


_SOURCE = (Step(2e-2, 0, 10, 20), Step(5e-3, 5e-3, 10, 30), Step(1e-3, 2e-3, 25, 20), Step(3e-4, 5e-4, 25, 10))
# By which factors a log's velocity is wrong is the estimator's, which no change of the vehicle changes. How late it is
# is the estimator's too, but flights after the change tell that one number better than the source does.
_SAME = ("velocity_gain",)
# A load on a cable comes with the change: fitted to flights without one it would take the air's moments for a pull.
_BROUGHT = ("cable_pull",)
_ADAPTATION = (
    Step(1e-2, 0, 10, 80, 30, _SAME),
    Step(3e-3, 3e-3, 10, 80, 30, _SAME),
    Step(1e-3, 1e-3, 25, 60, 20, _SAME),
)
_SCRATCH = (Step(2e-2, 0, 10, 120, 40), Step(5e-3, 5e-3, 10, 160, 40), Step(1e-3, 1e-3, 25, 60, 20))
# For another manoeuvre than those learned from: what turned the vehicle there is forgotten by ending early, and thrust
# and drag, which hold everywhere, are found where they show, in few steps.
_BRIEF = (Step(2e-2, 0, 10, 20), Step(0, 2e-3, 25, 5), Step(0, 1e-3, 50, 5))

_STAGED = Recipe(
    "physics, then all on 10 steps, then all on 25; the network adds to accelerations alone",
    *(25, _SOURCE, _ADAPTATION, _SCRATCH),
    outputs="accelerations",
    position=10.0,
)
_TURNING = "physics, then all on 10 steps, then all on 25; the network adds to the angular acceleration alone"
_SHORT = "physics, then all on 10 steps; the network adds to accelerations alone"
_CAREFUL = Recipe(
    "physics on 10 steps, then the network alone for a few epochs on 25 and 50; it adds to the angular acceleration",
    *(50, _BRIEF, _BRIEF, _BRIEF),
    outputs="angular_acceleration",
    position=10.0,
    # Where one manoeuvre is flown far more wildly than the others, squares would make it all that is learned.
    huber=0.2,
)

RECIPES: Mapping[str, Recipe] = {
    "staged": _STAGED,
    "turning": replace(_STAGED, about=_TURNING, outputs="angular_acceleration"),
    "short": replace(_STAGED, about=_SHORT, source=_SOURCE[:2], adaptation=_ADAPTATION[:2], scratch=_SCRATCH[:2]),
    "torque_off": replace(
        _CAREFUL,
        about=f"the rotors' torque is not used; {_CAREFUL.about}",
        physics="torque_off",
        learn=("k", "drag", "aerodynamic_moment", "rate_damping", "velocity_gain"),
    ),
    "frozen_rates": replace(
        _CAREFUL,
        about=f"of physics thrust and drag alone; {_CAREFUL.about}",
        physics="frozen_rates",
        learn=("k", "drag", "velocity_gain"),
    ),
}


def before_a_change(recipe: Recipe) -> tuple[Step, ...]:
    """The steps of the source's flights where a target's follow: what only the change brings stays as it is."""
    return tuple(replace(step, kept=(*step.kept, *_BROUGHT)) for step in recipe.source)


def stage_of(step: Step, model: str, share: float = 1.0) -> Stage:
    """The stage of one model.

    Args:
        share: of the epochs and of the patience.
    """
    epochs, patience = (max(1, round(share * count)) for count in (step.epochs, step.patience))
    match model:
        case "hybrid":
            rates = {"physics": step.physics, "residual": step.residual}
        case "no_physics":
            # It has no physics to begin with, and is given as many epochs.
            rates = {"residual": step.residual or NETWORK_ALONE}
        case _:
            rates = {"": step.physics}
    return Stage(rates, step.steps, epochs, patience)


def alike(model: str, recipe: str, among: Sequence[str]) -> str:
    """The first of some recipes that trains a model as the given one does: what a hybrid's network adds to is no
    concern of the others.
    """

    def training(name: str) -> Recipe:
        how = replace(RECIPES[name], about="")
        return how if model == "hybrid" else replace(how, outputs="motion")

    return next((name for name in among if training(name) == training(recipe)), recipe)


def share_of_epochs(size: int) -> float:
    """Few windows make few steps an epoch, so N windows are given √(1000 / N) times the epochs of 1000."""
    return (REFERENCE / size) ** 0.5
