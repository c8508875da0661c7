"""What windows must explain before a source is changed: more than it errs where nothing has changed.

A source errs a little on its own motion, and where it has not been, as in hover after fast flight, by up to what its
network adds there. Windows of one kind of motion show such an error as steadily as a change, and a correction of it
then ruins all other motion. So a candidate has to remove twice of what its parameters would explain of that error alone
(Mallows, Some comments on Cp, 1973), which is all of it for windows of one kind.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from hybrid_jax.dynamics.base import AbstractVectorField, state_space
from hybrid_jax.dynamics.composition import Hybrid
from hybrid_jax.dynamics.disturbance import physics_of
from hybrid_jax.estimation.least_squares import Scale, Solver, prediction_errors
from hybrid_jax.estimation.starts import Starts, from_starts, smoothed
from hybrid_jax.extrapolation import features_of, shares_outside
from hybrid_jax.trajectories import Trajectories

MARGIN = 2  # times the part of the source's own error that a candidate would explain


class Errors(NamedTuple):
    """Of a field on windows, squares over scale, a mean over windows and rows of errors.

    Attributes:
        starts: of the windows, see `smoothed`.
        noise: of one number over scale.
        own: error of the field beyond noise.
        network: what its network adds to the predictions.
    """

    starts: Starts | None
    noise: Float[Array, ""]
    own: Float[Array, ""]
    network: Float[Array, ""]


def errors_of(field: AbstractVectorField, windows: Trajectories, solver: Solver, scale: Scale) -> Errors:
    """The errors of a source, and what its network adds."""
    starts, noise = smoothed(field, windows, solver, scale)
    smooth, weigh = from_starts(windows, starts)

    def of(field) -> Array:
        return jax.lax.map(lambda window: prediction_errors(field, window, solver, scale), smooth, batch_size=64)

    own, added = of(field), jnp.zeros(())
    rows = weigh(own)
    if isinstance(field, Hybrid) and physics_of(field) is not field:  # its residual is a network
        added = jnp.sum(jnp.square(own - of(field.physics))) / rows[:, :, 0].size
    beyond = jnp.sum(jnp.square(rows)) - noise * own.size
    return Errors(starts, noise, jnp.maximum(beyond, 0.0) / rows[:, :, 0].size, added)


def alike(learned_from: Trajectories, windows: Trajectories) -> Trajectories:
    """As many windows of the source's motion as there are others, and no longer ones, so that one program serves."""
    places = np.linspace(0, len(learned_from) - 1, len(windows)).astype(int)
    t = windows.horizon
    own = Trajectories(learned_from.x0, learned_from.u[:, :t], learned_from.x[:, :t], learned_from.dt)
    return jax.tree.map(lambda leaf, other: jnp.asarray(leaf[places], other.dtype), own, windows)


class Unchanged(NamedTuple):
    """What is to be expected of windows after which nothing has changed.

    Attributes:
        error: of the source beyond noise, as `Errors.own`.
        places: how many windows differ in their motion as those of the source do.
    """

    error: Float[Array, ""]
    places: Float[Array, ""]

    def supports(self, removed: Float[Array, "*c"], fitted) -> Bool[Array, "*c"]:
        """Whether candidates remove more than such an error would let them.

        Args:
            removed: mean square that each removes of the source's errors.
            fitted: how many parameters each fits.
        """
        return removed > MARGIN * self.error * jnp.minimum(1.0, fitted / self.places)


def unchanged(field, windows: Trajectories, found: Errors, own: Errors, learned_from: Trajectories) -> Unchanged:
    """What to expect from the errors on windows, and those on `alike` windows of the source's motion."""
    space = state_space(field, windows.x0.shape[-1])
    known, asked = (features_of(each, space) for each in (learned_from, windows))
    outside, missed = (max(shares_outside(*pair).values()) for pair in ((known, asked), (asked, known)))
    longer = windows.horizon * windows.dt / (min(learned_from.horizon, windows.horizon) * learned_from.dt)
    error = own.own * max(1.0, longer) ** 2 + outside * missed * found.network
    return Unchanged(error, jnp.asarray(max(1.0, (1 - missed) * len(windows))))
