"""Training on windows of records in which only some states were measured."""

from dataclasses import dataclass, replace

from jaxtyping import Array, Float

from hybrid_jax import metrics
from hybrid_jax.dynamics.composition import Hybrid
from hybrid_jax.dynamics.outputs import StateSpaceModel
from hybrid_jax.estimation.record_windows import RecordWindows, checked_windows
from hybrid_jax.training.loss import rollout_minibatch
from hybrid_jax.training.objective import UNSCALED, Objective, Settings


@dataclass(frozen=True)
class RecordLoss(Objective):
    """The squared errors of a `StateSpaceModel`'s outputs over their noise, averaged over samples; + λ L_reg."""

    def prepare(self, windows: RecordWindows, name: str) -> RecordWindows:
        return checked_windows(windows, name)

    def loss(self, field: StateSpaceModel, batch: RecordWindows, settings: Settings, weight: Float[Array, ""]):
        own = UNSCALED.batch(batch.states, settings)
        states = rollout_minibatch(field.field, own.x0, own.u, own.dt, own.solver)
        value = batch.loss(field, states.transpose(2, 0, 1))
        if settings.regulariser is not None and isinstance(field.field, Hybrid):
            value = value + weight * settings.regulariser(field.field, own, states)
        return value, states

    def observe(self, field: StateSpaceModel, batch: RecordWindows, seen: Float[Array, "t d b"]) -> StateSpaceModel:
        own = UNSCALED.batch(batch.states, Settings())
        return replace(field, field=UNSCALED.observe(field.field, own, seen))

    def validate(self, field: StateSpaceModel, data: RecordWindows, settings: Settings) -> Float[Array, ""]:
        known = data.states
        return data.loss(field, metrics.predict(field.field, known.x0, known.u, known.dt, settings.solver))
