"""Images of the simulated vehicle (Fig. 6), rendered by MuJoCo in a process of its own.

MuJoCo chooses its OpenGL backend when it is first imported; one backend after the other is tried.
"""

# MuJoCo's compiled modules carry no type stubs.
# pyright: reportAttributeAccessIssue=false

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import matplotlib.image
import numpy as np
from jaxtyping import Float, UInt8

POSE = (0.0, 0.0, 0.30, 0.995, -0.04, 0.07, 0.05)  # position [m] and (w, x, y, z), which MuJoCo normalises
WIDTH, HEIGHT = 1600, 1200  # pixels
FRAME_WIDTH, FRAME_HEIGHT = 320, 240
CHILD = "from experiments.flying import images; images._write()"

Images = UInt8[np.ndarray, "n h w 3"]


def picture(path: str | Path) -> None:
    """Write the rendered vehicle as a PNG; ValueError if no off-screen backend works, or for another suffix."""
    if Path(path).suffix.lower() != ".png":
        raise ValueError(f"{path}: a picture's name must end in .png")
    matplotlib.image.imsave(path, _rendered([POSE], HEIGHT, WIDTH, None)[0])


def frames(poses: Float[np.ndarray, "n 7"], place: Float[np.ndarray, "3"]) -> Images:
    """Images of the vehicle seen from ahead, and of a red mark; ValueError if no off-screen backend works.

    Args:
        poses: position [m] and quaternion (w, x, y, z), world frame.
        place: of the mark [m, world].
    """
    return _rendered(poses.tolist(), FRAME_HEIGHT, FRAME_WIDTH, place.tolist())


def _rendered(*arguments) -> Images:
    """The images of `_render`, run in another process with the first backend that works."""
    chosen = os.environ.get("MUJOCO_GL")
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "images.npy"
        command = [sys.executable, "-c", CHILD, str(file), json.dumps(arguments)]
        for backend in (chosen,) if chosen else ("egl", "osmesa"):
            environment = {**os.environ, "MUJOCO_GL": backend}
            if subprocess.run(command, env=environment, capture_output=True, check=False).returncode == 0:
                return np.load(file)
    raise ValueError(
        "no off-screen renderer works here: install the system package libosmesa6 or libegl1 "
        "(set MUJOCO_GL to osmesa or egl to choose one)"
    )


def _render(poses: list[list[float]], height: int, width: int, place: list[float] | None) -> Images:
    """Images of the Iris, with a red mark and a camera that looks at it if a place is given."""
    import mujoco

    from hybrid_jax.sim.scene import build_model
    from hybrid_jax.vehicle import IRIS

    model = build_model(IRIS)
    data, images, camera = mujoco.MjData(model), [], "portrait"
    if place:
        camera = mujoco.MjvCamera()
        camera.lookat, camera.distance, camera.azimuth, camera.elevation = place, 1.5, 180.0, -12.0
    with mujoco.Renderer(model, height, width) as renderer:
        for pose in poses:
            data.qpos[:7] = pose
            mujoco.mj_forward(model, data)
            renderer.update_scene(data, camera=camera)
            if place:
                mark = renderer.scene.geoms[renderer.scene.ngeom]
                kind, red = mujoco.mjtGeom.mjGEOM_SPHERE, np.array([0.85, 0.1, 0.1, 1.0], np.float32)
                mujoco.mjv_initGeom(mark, kind, np.full(3, 0.03), np.array(place), np.eye(3).ravel(), red)
                renderer.scene.ngeom += 1
            images.append(renderer.render().copy())
    return np.stack(images)


def _write() -> None:
    """Write the images that the command line of the other process asks for."""
    np.save(sys.argv[1], _render(*json.loads(sys.argv[2])))
