"""Learning rates and early stopping of the paper's protocol (App. A)."""

from dataclasses import dataclass

from experiments.runner.options import CountFromZero, NotNegative, Positive


@dataclass(frozen=True)
class Rates:
    """Adam's learning rates; a tuple has one for each of the sizes 100, 300, 500, 700, 1000."""

    physics: NotNegative = 1e-2
    """Rate of θ_p in pre-training and target-only."""
    physics_fine_tuning: NotNegative = 1e-2
    """Rate of θ_p in fine-tuning; not confirmed in the paper. Claims C8 and C10 of param_shift are sensitive to it."""
    pretraining: NotNegative = 1e-4
    """Rate of θ_d in pre-training, both models."""
    decay: tuple[Positive, ...] = ()
    """Factors: pre-training continues from its best model with all rates times each factor in turn; none by default."""
    hybrid: tuple[NotNegative, ...] = (1e-3, 1e-4, 1e-4, 1e-4, 1e-3)
    """Rate of the hybrid's θ_d, fine-tuned and target-only."""
    offset: Positive | None = None
    """Rate of v̇ and ω̇ in the output bias of θ_d [m/s², rad/s² a step], fine-tuned and target-only; by default the
    rate of θ_d. Only this bias can represent a constant force; at 1e-3 you need thousands of steps, which overfit."""


@dataclass(frozen=True)
class AllRates(Rates):
    """Learning rates also for experiments with a network without physics."""

    no_physics: tuple[NotNegative, ...] = (1e-4, 1e-4, 1e-4, 1e-4, 1e-5)
    """Rate of the network without physics, fine-tuned (the first four are not confirmed in the paper)."""
    no_physics_target_only: NotNegative = 1e-4
    """Rate of the network without physics, target-only."""


@dataclass(frozen=True)
class Stopping:
    """At least `minimum` epochs, then stop after `patience` epochs without a better validation loss."""

    minimum: CountFromZero
    patience: CountFromZero


@dataclass(frozen=True)
class Patience:
    """Early stopping; a tuple has one entry for each of the sizes 100, 300, 500, 700, 1000."""

    hybrid_pretraining: Stopping = Stopping(100, 20)
    hybrid_minimum: tuple[CountFromZero, ...] = (100, 300, 300, 300, 100)
    hybrid_patience: tuple[CountFromZero, ...] = (20, 50, 50, 50, 20)


@dataclass(frozen=True)
class AllPatience(Patience):
    """Early stopping also of a network without physics."""

    no_physics_pretraining: Stopping = Stopping(300, 50)
    no_physics: Stopping = Stopping(250, 50)
