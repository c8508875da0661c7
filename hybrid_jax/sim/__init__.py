"""The true system: a quadrotor in MuJoCo MJX with the forces that the physics model does not know.

Raises:
    ImportError: mujoco and mujoco-mjx are missing or of different minor versions. The two integrate a free body
        differently across versions, and mujoco-mjx sets no upper bound on mujoco.
"""

import contextlib
import io
from importlib.metadata import PackageNotFoundError, version

MUJOCO_MINOR = "3.17"


def check_versions(mujoco: str | None, mjx: str | None) -> None:
    """Accept two versions, None for a package that is missing, that are both 3.17.*.

    Raises:
        ImportError: what is installed and the command that mends it.
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

# Importing mjx reports the optional Warp backend on stdout, which belongs to our programs' results.
with contextlib.redirect_stdout(io.StringIO()):
    import mujoco.mjx  # noqa: F401
