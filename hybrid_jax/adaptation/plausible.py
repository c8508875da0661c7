"""The changes that an adaptation considers and their plausible sizes: a prior, so that noise is not fitted."""

from collections.abc import Mapping, Sequence
from dataclasses import astuple, dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from hybrid_jax import checks
from hybrid_jax.dynamics.base import AbstractVectorField
from hybrid_jax.dynamics.disturbance import sized, with_disturbance
from hybrid_jax.dynamics.rigid_body import corrected
from hybrid_jax.dynamics.terms import OF_AIR
from hybrid_jax.estimation.learned_numbers import logarithms
from hybrid_jax.estimation.least_squares import ravel_parameters
from hybrid_jax.estimation.uncertainty import named_parameters, names_of
from hybrid_jax.runtime import UNOPTIMISED, jit_by_size
from hybrid_jax.trajectories import Trajectories

THETA = ("theta", "aerodynamics")  # the groups of θ_p
# The groups of the parameters of a corrected rigid body; the others are in theta.
GROUPS = dict.fromkeys((*OF_AIR, "rate_damping"), "aerodynamics")
GROUPS |= {"efficiency": "efficiency", "reaction_torque": "reaction_torque", "added_drag": "drag"}
GROUPS |= {"wind": "wind", "wind[2]": "updraft", "mass_ratio": "mass", "centre_shift": "centre"}
GROUPS |= {f"disturbance[v{axis}]": "force" for axis in "xyz"} | {f"disturbance[w{axis}]": "torque" for axis in "xyz"}

# The groups of parameters that each candidate fits. A candidate applies if the field has all of its groups.
_CHANGES: Mapping[str, tuple[str, ...]] = {
    "source": (),
    "theta": ("theta",),
    "reaction_torque": ("reaction_torque",),
    "theta_reaction_torque": ("theta", "reaction_torque"),
    "disturbance": ("theta", "disturbance"),
    "force": ("theta", "force"),
    "wind": ("theta", "wind", "updraft"),
    "drag": ("theta", "drag"),
    "efficiency": ("theta", "efficiency"),
    "load": ("theta", "mass", "centre"),
    "force_load": ("theta", "force", "mass", "centre"),
    "wind_load": ("theta", "wind", "updraft", "mass", "centre"),
    "force_torque": ("theta", "force", "torque"),
    "force_drag": ("theta", "force", "drag"),
    "force_efficiency": ("theta", "force", "efficiency"),
    "force_torque_drag": ("theta", "force", "torque", "drag"),
    "all": ("theta", "force", "torque", "drag", "efficiency", "reaction_torque"),
}
# Physics may have twenty aerodynamic coefficients, and each that is fitted costs evidence: so they are held, or free.
CANDIDATES = _CHANGES | {
    f"{name}_aerodynamics": (*groups, "aerodynamics") for name, groups in _CHANGES.items() if "theta" in groups
}
WORDS = {
    "source": "no change",
    "theta": "new physical parameters",
    "aerodynamics": "aerodynamic coefficients",
    "reaction_torque": "a factor of all reaction torques",
    "disturbance": "a constant disturbance",
    "force": "a constant force",
    "wind": "a steady horizontal wind",
    "updraft": "an updraft",
    "torque": "a constant torque",
    "drag": "drag along each axis of the body",
    "efficiency": "the efficiency of each rotor",
    "mass": "the mass with a load",
    "centre": "the centre of mass",
}
# Parameters of θ_p that are not identifiable beside those of a group.
CONFOUNDED = {"efficiency": ("k", "k_rotors"), "mass": ("k", "k_rotors", "mass"), "centre": ("centre_of_mass",)}


@dataclass(frozen=True)
class Plausible:
    """How large changes usually are: standard deviations of a normal prior that is centred at the source.

    Attributes:
        theta: each parameter of a rigid body in its own parametrisation, for example 0.3 for 30 % of a ratio.
        relative: each parameter of another system, relative to the source's value; a parameter that is 0 is free. It
            is absolute for a logarithm, whose name should begin with log_.
        force: constant force over the mass [m/s²].
        wind: horizontal components of a steady wind [m/s].
        updraft: its vertical component [m/s].
        torque: constant torque over the inertia [rad/s²].
        drag: added drag over the mass [1/s].
        aerodynamics: coefficients of drag, lift, aerodynamic moments and damping, relative to the vehicle's weight and
            arm at 1 m/s (lift: 10 m/s; damping: 10 rad/s).
        efficiency: logarithm of each rotor's efficiency.
        mass: logarithm of the mass with a load over the mass before.
        centre: shift of the centre of mass along x and y, relative to the vehicle's arm.
        reaction_torque: logarithm of a factor of all reaction torques.
        disturbance: constant disturbance of another system, relative to each state's RMS rate in the windows.

    Raises:
        ValueError: if a size is not positive.
    """

    theta: float = 0.3
    relative: float = 1.0
    force: float = 2.0
    torque: float = 5.0
    wind: float = 3.0
    updraft: float = 0.5
    drag: float = 0.5
    aerodynamics: float = 0.05
    efficiency: float = 0.3
    mass: float = 0.3
    centre: float = 0.2
    reaction_torque: float = 0.3
    disturbance: float = 1.0

    def __post_init__(self):
        for name, value in zip(vars(self), astuple(self), strict=True):
            checks.positive(name, value)

    def sizes(self, field: AbstractVectorField, windows: Trajectories) -> Float[Array, " p"]:
        """Return the sizes of an extended source's parameters, in the order of `ravel_parameters`; infinite if free.

        Args:
            field: the extended source.
            windows: windows of the changed system.
        """
        names, theta = names_of(field), ravel_parameters(field)[0]
        groups = groups_of(names)
        k = groups.count("disturbance")
        parts = k if k and windows.x0.shape[1] % k == 0 else 1  # each component of a grid is one part
        rates = (windows.x[:, -1] - windows.x0) / (windows.horizon * windows.dt)
        rates = jnp.sqrt(jnp.nanmean(jnp.square(rates).reshape(len(rates), parts, -1), axis=(0, 2)))
        if "drag" in groups:
            sizes = jnp.asarray([getattr(self, group) for group in groups], theta.dtype)
        else:
            steady = np.array(groups) == "disturbance"
            rates = jnp.broadcast_to(rates, (max(parts, k),))[np.maximum(np.cumsum(steady) - 1, 0)]
            sizes = jnp.where(steady, self.disturbance * rates, self.relative_to(names, theta))
        return jnp.where(sizes > 0, sizes, jnp.inf)

    def relative_to(self, names: Sequence[str], theta: Float[Array | np.ndarray, " p"]) -> Float[Array, " p"]:
        """Return the standard deviations (p) of changes by `relative`.

        Args:
            names: the parameters; one that begins with log_ is a logarithm, whose change does not depend on its value.
            theta: their values (p).
        """
        return self.relative * jnp.where(logarithms(names), 1.0, jnp.abs(theta))


def extended(field: AbstractVectorField, d: int) -> AbstractVectorField:
    """Add all parameters that a candidate may fit, at values that change nothing."""
    return sized(with_disturbance(corrected(field)), d)


@jit_by_size(UNOPTIMISED)  # one by one, these small operations take as long to compile as a rollout
def _numbers(field: AbstractVectorField, d: int | None) -> list[Array]:
    return [*named_parameters(field if d is None else extended(field, d)).values()]


def values_of(field: AbstractVectorField, d: int | None = None) -> dict[str, float]:
    """Return the physics' parameters by name; given the size d of the state, of the `extended` field."""
    named = field if d is None else eqx.filter_eval_shape(extended, field, d)
    return dict(zip(names_of(named), map(float, jax.device_get(_numbers(field, d))), strict=True))


def groups_of(names: Sequence[str]) -> list[str]:
    steady = {name for name in names if name.startswith("disturbance[")}
    groups = GROUPS if steady <= GROUPS.keys() else GROUPS | dict.fromkeys(steady, "disturbance")
    return [groups.get(name, groups.get(name.split("[")[0], "theta")) for name in names]


def free_parameters(field: AbstractVectorField) -> dict[str, np.ndarray]:
    """Return which parameters of an extended field each candidate fits (c, p)."""
    names, found = names_of(field), {}
    group = groups_of(names)
    for name, fitted in CANDIDATES.items():
        if set(fitted) <= {*group, "theta"}:
            lost = {other for each in fitted for other in CONFOUNDED.get(each, ())}
            pairs = zip(names, group, strict=True)
            found[name] = np.array([each in fitted and own.split("[")[0] not in lost for own, each in pairs])
    return found


def kept_parameters(field: AbstractVectorField) -> Bool[np.ndarray, "c p"]:
    """Return which of θ_p each candidate keeps though it could be fitted; see `free_parameters`."""
    names = names_of(field)
    theta = np.isin(groups_of(names), THETA)
    lost = [{other for each in CANDIDATES[one] for other in CONFOUNDED.get(each, ())} for one in free_parameters(field)]
    confounded = np.array([[name.split("[")[0] in own for name in names] for own in lost])
    return theta & ~confounded & ~np.stack([*free_parameters(field).values()])


def rivals(candidates: Sequence[str]) -> Int[np.ndarray, " c"]:
    """Return the index of the candidate with a wind in place of each one's force, or a force in place of a wind.

    It is the candidate's own if there is none. To first order the two are alike.
    """
    swapped = {
        one: one.replace("wind", "force") if "wind" in one else one.replace("force", "wind") for one in candidates
    }
    return np.array([candidates.index(other if other in candidates else one) for one, other in swapped.items()])
