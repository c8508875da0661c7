"""How far a changed system plausibly is from the source: the prior of an adaptation.

A direction of the parameters that a flight does not excite then stays where it was, however well it fits some noise.
"""

from collections.abc import Sequence
from dataclasses import astuple, dataclass

import jax.numpy as jnp
from jaxtyping import Array, Float

from hybrid_jax import checks
from hybrid_jax.dynamics.base import AbstractVectorField
from hybrid_jax.estimation.least_squares import ravel_parameters
from hybrid_jax.estimation.uncertainty import named_parameters
from hybrid_jax.trajectories import Trajectories

# Parameters of a corrected rigid body; the others are its own, θ_p.
GROUPS = {"efficiency": "efficiency", "added_drag": "drag"}
GROUPS |= {f"disturbance[v{axis}]": "force" for axis in "xyz"} | {f"disturbance[w{axis}]": "torque" for axis in "xyz"}


@dataclass(frozen=True)
class Plausible:
    """One standard deviation of what may change; the prior is normal, with the source as its mean.

    Attributes:
        theta: of each parameter of a rigid body as it holds it, such as the logarithm of a ratio: 0.3 is 30 percent.
        relative: of a parameter of another system, over the size of the source's; one that is 0 there is free.
        force: steady, over the mass [m/s²].
        torque: steady, over the inertia [rad/s²].
        drag: added, over the mass [1/s].
        efficiency: the logarithm of each rotor's.
        disturbance: constant, of another system, over the RMS rate of each state in the windows.

    Raises:
        ValueError: a size that is not positive.
    """

    theta: float = 0.3
    relative: float = 1.0
    force: float = 2.0
    torque: float = 5.0
    drag: float = 0.5
    efficiency: float = 0.3
    disturbance: float = 1.0

    def __post_init__(self):
        for name, value in zip(vars(self), astuple(self), strict=True):
            checks.positive(name, value)

    def sizes(self, field: AbstractVectorField, windows: Trajectories) -> Float[Array, " p"]:
        """Of each parameter of an extended source, in the order of `ravel_parameters`; infinite for one that is free.

        Args:
            field: the extended source.
            windows: of the changed system.
        """
        groups, theta = groups_of([*named_parameters(field)]), ravel_parameters(field)[0]
        k = groups.count("disturbance")
        parts = k if k and windows.x0.shape[1] % k == 0 else 1  # of a grid a component is one part
        rates = (windows.x[:, -1] - windows.x0) / (windows.horizon * windows.dt)
        rates = jnp.sqrt(jnp.mean(jnp.square(rates).reshape(len(rates), parts, -1), axis=(0, 2)))
        steady, found = iter(jnp.broadcast_to(rates, (max(parts, k),))), []
        for group, value in zip(groups, theta, strict=True):
            if group == "disturbance":
                found.append(self.disturbance * next(steady))
            else:
                found.append(getattr(self, group) if "drag" in groups else self.relative * jnp.abs(value))
        sizes = jnp.asarray(found, theta.dtype)
        return jnp.where(sizes > 0, sizes, jnp.inf)


def groups_of(names: Sequence[str]) -> list[str]:
    """Which group each parameter of an extended field belongs to, by its name."""
    steady = {name for name in names if name.startswith("disturbance[")}
    groups = GROUPS if steady <= GROUPS.keys() else GROUPS | dict.fromkeys(steady, "disturbance")
    return [groups.get(name, groups.get(name.split("[")[0], "theta")) for name in names]
