"""Render the vehicle with MuJoCo (Fig. 6): `python -m hybrid_jax.sim.render FILE.png`.

MuJoCo chooses its OpenGL backend when it is first imported, so `picture` and `frames` render in a separate process and
try one backend after the other.
"""

# MuJoCo's compiled modules carry no type stubs.
# pyright: reportAttributeAccessIssue=false

import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

WIDTH, HEIGHT = 1600, 1200  # pixels
BACKENDS = ("egl", "osmesa")
POSE = (0.0, 0.0, 0.30, 0.995, -0.04, 0.07, 0.05)  # position [m] and (w, x, y, z), which MuJoCo normalises
FRAME_WIDTH, FRAME_HEIGHT = 320, 240


def picture(path: str | Path) -> None:
    """Write the rendered vehicle as a PNG of 1600 × 1200 pixels.

    Raises:
        ValueError: the name does not end in .png, or no off-screen backend works; says what to install.
    """
    if Path(path).suffix.lower() != ".png":
        raise ValueError(f"{path}: a picture's name must end in .png")
    _run([str(path)], path)


def frames(poses: Float[np.ndarray, "n 7"], place: Float[np.ndarray, "3"]) -> UInt8[np.ndarray, "n h w 3"]:
    """Images of the vehicle in the given poses, seen from ahead, with a red mark.

    Args:
        poses: position [m] and quaternion (w, x, y, z), world frame.
        place: of the mark [m, world].

    Raises:
        ValueError: no off-screen backend works; says what to install.
    """
    with tempfile.TemporaryDirectory() as folder:
        asked, drawn = Path(folder) / "poses.npy", Path(folder) / "frames.npy"
        np.save(asked, np.vstack([np.pad(place, (0, 4)), poses]))
        _run([str(asked), str(drawn)], "frames")
        return np.load(drawn)


def _run(arguments: list[str], what: str | Path) -> None:
    """Run this module in a separate process, with the first backend that works."""
    chosen = os.environ.get("MUJOCO_GL")
    for backend in (chosen,) if chosen else BACKENDS:
        environment = {**os.environ, "MUJOCO_GL": backend}
        command = [sys.executable, "-m", "hybrid_jax.sim.render", *arguments]
        if subprocess.run(command, env=environment, capture_output=True, check=False).returncode == 0:
            return
    raise ValueError(
        f"{what}: no off-screen renderer works here: install the system package libosmesa6 or libegl1 "
        "(set MUJOCO_GL to osmesa or egl to choose one)"
    )


def _draw(
    poses: Float[np.ndarray, "n 7"], height: int, width: int, camera: Any, place: Float[np.ndarray, "3"] | None = None
) -> UInt8[np.ndarray, "n h w 3"]:
    """Images of the vehicle, and of a mark at a place, in this process."""
    import mujoco

    from hybrid_jax.sim.model import build_model
    from hybrid_jax.vehicle import IRIS

    model = build_model(IRIS)
    data, images = mujoco.MjData(model), []
    with mujoco.Renderer(model, height, width) as renderer:
        for pose in poses:
            data.qpos[:7] = pose
            mujoco.mj_forward(model, data)
            renderer.update_scene(data, camera=camera)
            if place is not None:
                mark = renderer.scene.geoms[renderer.scene.ngeom]
                kind, red = mujoco.mjtGeom.mjGEOM_SPHERE, np.array([0.85, 0.1, 0.1, 1.0], np.float32)
                mujoco.mjv_initGeom(mark, kind, np.full(3, 0.03), place, np.eye(3).ravel(), red)
                renderer.scene.ngeom += 1
            images.append(renderer.render().copy())
    return np.stack(images)


def _draw_picture(path: str) -> None:
    import matplotlib.image

    matplotlib.image.imsave(path, _draw(np.array([POSE]), HEIGHT, WIDTH, "portrait")[0])


def _draw_frames(asked: str, drawn: str) -> None:
    """Render the poses in one file of `frames` into another."""
    import mujoco

    place, *poses = np.load(asked)
    camera = mujoco.MjvCamera()
    camera.lookat, camera.distance, camera.azimuth, camera.elevation = place[:3], 1.5, 180.0, -12.0
    np.save(drawn, _draw(np.array(poses), FRAME_HEIGHT, FRAME_WIDTH, camera, place[:3]))


def main(arguments: list[str]) -> int:
    """The command line. Renders in this process if MUJOCO_GL is set. Exit code 2 and one line if no backend works."""
    try:
        match arguments:
            case [asked, drawn]:
                _draw_frames(asked, drawn)
            case [path] if "MUJOCO_GL" in os.environ:
                _draw_picture(path)
            case [path]:
                picture(path)
            case _:
                raise ValueError("give one file name, FILE.png")
    except ValueError as error:
        print(f"render: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
