"""A simulated quadrotor in MuJoCo MJX with drag, ground effect and wind, and a pilot for random flights."""

from hybrid_jax.io.datasets import versions


def check_versions(found: dict[str, str]) -> None:
    """Raise ImportError, with the install command, unless both are 3.17.*: others integrate a free body differently."""
    if not all(found[package].startswith("3.17.") for package in ("mujoco", "mujoco-mjx")):
        raise ImportError(
            f"hybrid_jax.sim needs mujoco and mujoco-mjx 3.17.*, found mujoco {found['mujoco']} and mujoco-mjx "
            f'{found["mujoco-mjx"]}: pip install "mujoco==3.17.*" "mujoco-mjx==3.17.*"'
        )


check_versions(versions("mujoco", "mujoco-mjx"))

from hybrid_jax.sim.domain import EXTERNAL_FORCE, PARAMETER_SHIFT, SOURCE, Domain, Quadrotor  # noqa: E402
from hybrid_jax.sim.flight import Flights, SplitSpec, gone_wrong, make_dataset, random_flights  # noqa: E402

__all__ = [
    "EXTERNAL_FORCE",
    "PARAMETER_SHIFT",
    "SOURCE",
    "Domain",
    "Flights",
    "Quadrotor",
    "SplitSpec",
    "gone_wrong",
    "make_dataset",
    "random_flights",
]
