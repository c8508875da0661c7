"""The true system: a quadrotor in MuJoCo MJX with drag, ground effect and wind, and a pilot for random flights.

Raises:
    ImportError: mujoco or mujoco-mjx is missing or of an unsupported version. The two integrate a free body differently
        across versions, and mujoco-mjx sets no upper bound on mujoco.
"""

import contextlib
import io
from importlib.metadata import PackageNotFoundError, version

MUJOCO_MINOR = "3.17"


def check_versions(mujoco: str | None, mjx: str | None) -> None:
    """Check two versions; None for a package that is missing.

    Raises:
        ImportError: one is not 3.17.*; the message has the installed versions and the command to install others.
    """
    if not all(found and found.split(".")[:2] == MUJOCO_MINOR.split(".") for found in (mujoco, mjx)):
        raise ImportError(
            f"hybrid_jax.sim needs mujoco and mujoco-mjx {MUJOCO_MINOR}.*, found mujoco {mujoco or 'missing'} and "
            f'mujoco-mjx {mjx or "missing"}: pip install "mujoco=={MUJOCO_MINOR}.*" "mujoco-mjx=={MUJOCO_MINOR}.*"'
        )


def _installed(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None


check_versions(_installed("mujoco"), _installed("mujoco-mjx"))

# Importing mjx prints a message about its optional Warp backend to stdout.
with contextlib.redirect_stdout(io.StringIO()):
    import mujoco.mjx  # noqa: F401

from hybrid_jax.sim.domain import EXTERNAL_FORCE, PARAMETER_SHIFT, SOURCE, Domain  # noqa: E402
from hybrid_jax.sim.flight import Flights, fly, gone_wrong  # noqa: E402
from hybrid_jax.sim.quadrotor import Quadrotor  # noqa: E402
from hybrid_jax.sim.record import SplitSpec, make_dataset  # noqa: E402

__all__ = [
    "EXTERNAL_FORCE",
    "PARAMETER_SHIFT",
    "SOURCE",
    "Domain",
    "Flights",
    "Quadrotor",
    "SplitSpec",
    "fly",
    "gone_wrong",
    "make_dataset",
]
