"""The numbers of a row about an adapted model: its error, parameters, intervals, and expected errors."""

from collections.abc import Mapping
from typing import Any

import jax.numpy as jnp
import numpy as np

import hybrid_jax as hj
from experiments.paper.study import EVERY
from experiments.worlds.world import World
from hybrid_jax.adaptation.expectation import Expected
from hybrid_jax.adaptation.results import Parameter
from hybrid_jax.dynamics.rigid_body import LEARNED, RIGID_BODY_SPACE, nominal
from hybrid_jax.integrate import rollout_batch
from hybrid_jax.metrics import rollout_mse
from hybrid_jax.runtime import FAST_COMPILE, jit_with

HORIZONS = {"0.1 s": 10, "1 s": 100}  # intervals
EXPECTED = tuple(f"expected {name}" for name in HORIZONS)  # columns


@jit_with(FAST_COMPILE)
def error_of(field: hj.AbstractVectorField, test: hj.Trajectories):
    """L^T_MSE, at every 0.1 s of a second."""
    return rollout_mse(field, test, EVERY)


def parameters_of(world: World, change: str, found: Mapping[str, Parameter]) -> dict[str, Any]:
    """Return error, half-width and coverage of the 95 % interval for each of θ_p; None without a true value.

    A weak rotor has no k of its own, and since the model's mass is fixed, another mass changes θ_p. The interval of a
    parameter that keeps the source's value counts separately, as it says what the flight does not exclude.
    """
    vehicle, truth = world.changed(change), nominal(world.changed(change))
    other_mass = vehicle.mass != world.vehicle.mass
    row: dict[str, Any] = {}
    for name in LEARNED:
        known = name in found and not other_mass and (name, change) != ("k", "weak_rotor")
        one = found[name] if known else Parameter(np.nan)
        bounded = known and one.has_interval and np.isfinite(one.high)
        inside = bool(one.low <= truth[name] <= one.high) if bounded else None
        kept = one.value == one.before
        row |= {
            f"{name}_error": one.value / truth[name] - 1 if known else None,
            f"{name}_half_width": (one.high - one.low) / (2 * truth[name]) if bounded else None,
            f"{name}_effective": known and one.effective is not None,
            f"{name}_inside": None if kept else inside,
            f"{name}_kept_inside": inside if kept else None,
        }
    return row


@jit_with(FAST_COMPILE)
def _ends(field: hj.AbstractVectorField, windows: hj.Trajectories):
    """Return errors at the ends of consecutive pieces of these lengths."""

    def after(steps: int):
        starts = jnp.concatenate([windows.x0[:, None], windows.x[:, steps - 1 : -1 : steps]], axis=1)
        u = windows.u.reshape(-1, steps, windows.u.shape[-1])
        ends = rollout_batch(field, starts.reshape(len(u), -1), u, windows.dt)[:, -1]
        return ends - windows.x[:, steps - 1 :: steps].reshape(len(u), -1)

    return tuple(map(after, HORIZONS.values()))


def expected_inside(
    field: hj.AbstractVectorField, expected: Expected, flights: list[hj.Trajectories]
) -> dict[str, Any]:
    """Return by horizon the share of flights and quantities inside the 80 % interval; None without intervals."""
    inside: dict[str, list[bool]] = {name: [] for name in HORIZONS}
    for windows in flights:
        for horizon, away in zip(HORIZONS, _ends(field, windows), strict=True):
            for part, one in RIGID_BODY_SPACE.parts:
                if one.name in expected.get(horizon, {}):
                    rmse = one.scale * np.sqrt(np.mean(np.sum(np.square(away[:, part]), axis=1)))
                    _, low, high = expected[horizon][one.name]
                    inside[horizon].append(bool(low <= rmse <= high))
    return dict(zip(EXPECTED, (float(np.mean(each)) if each else None for each in inside.values()), strict=True))
