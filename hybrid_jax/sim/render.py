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

import numpy as np
from jaxtyping import Float, UInt8

WIDTH, HEIGHT = 1600, 1200  # pixels
BACKENDS = ("egl", "osmesa")
ALTITUDE = 0.30  # m
FRAME_WIDTH, FRAME_HEIGHT = 320, 240
FRAMES = "--frames"
ATTITUDE = (0.995, -0.04, 0.07, 0.05)  # (w, x, y, z), not quite unit; MuJoCo normalises it


def picture(path: str | Path) -> None:
    """Write the rendered vehicle as a PNG of 1600 × 1200 pixels.

    Raises:
        ValueError: the name does not end in .png, or no off-screen backend works; says what to install.
    """
    if Path(path).suffix.lower() != ".png":
        raise ValueError(f"{path}: a picture's name must end in .png")
    _drawn([str(path)], path)


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
        _drawn([FRAMES, str(asked), str(drawn)], "frames")
        return np.load(drawn)


def _drawn(arguments: list[str], what: str | Path) -> None:
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


def draw(path: str | Path) -> None:
    """Render in this process, with the backend in MUJOCO_GL."""
    import matplotlib.image
    import mujoco

    from hybrid_jax.sim.model import build_model
    from hybrid_jax.vehicle import IRIS

    model = build_model(IRIS)
    data = mujoco.MjData(model)
    data.qpos[2:7] = ALTITUDE, *ATTITUDE
    mujoco.mj_forward(model, data)
    with mujoco.Renderer(model, HEIGHT, WIDTH) as renderer:
        renderer.update_scene(data, camera="portrait")
        matplotlib.image.imsave(path, renderer.render())


def draw_frames(asked: str | Path, drawn: str | Path) -> None:
    """Render the poses in one file of `frames` into another, in this process."""
    import mujoco

    from hybrid_jax.sim.model import build_model
    from hybrid_jax.vehicle import IRIS

    place, *poses = np.load(asked)
    model = build_model(IRIS)
    data = mujoco.MjData(model)
    camera = mujoco.MjvCamera()
    camera.lookat, camera.distance, camera.azimuth, camera.elevation = place[:3], 1.5, 180.0, -12.0
    images = []
    with mujoco.Renderer(model, FRAME_HEIGHT, FRAME_WIDTH) as renderer:
        for pose in poses:
            data.qpos[:7] = pose
            mujoco.mj_forward(model, data)
            renderer.update_scene(data, camera=camera)
            mark = renderer.scene.geoms[renderer.scene.ngeom]
            kind, red = mujoco.mjtGeom.mjGEOM_SPHERE, np.array([0.85, 0.1, 0.1, 1.0], np.float32)
            mujoco.mjv_initGeom(mark, kind, np.full(3, 0.03), place[:3], np.eye(3).ravel(), red)
            renderer.scene.ngeom += 1
            images.append(renderer.render().copy())
    np.save(drawn, np.stack(images))


def main(arguments: list[str]) -> int:
    """The command line. Renders in this process if MUJOCO_GL is set. Exit code 2 and one line if no backend works."""
    if len(arguments) == 3 and arguments[0] == FRAMES:
        draw_frames(*arguments[1:])
        return 0
    if len(arguments) != 1:
        print("render: give one file name, FILE.png", file=sys.stderr)
        return 2
    if "MUJOCO_GL" in os.environ:
        draw(arguments[0])
        return 0
    try:
        picture(arguments[0])
    except ValueError as error:
        print(f"render: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
