"""Image of the simulated vehicle (Fig. 6), rendered by MuJoCo in a process for each OpenGL backend until one works."""

# MuJoCo's compiled modules carry no type stubs.
# pyright: reportAttributeAccessIssue=false

import os
import subprocess
import sys
from pathlib import Path

import matplotlib.image

POSE = (0.0, 0.0, 0.30, 0.995, -0.04, 0.07, 0.05)  # position [m] and (w, x, y, z), which MuJoCo normalises
WIDTH, HEIGHT = 1600, 1200  # pixels
CHILD = "import sys; from experiments.flying import images; images.render(sys.argv[1])"


def picture(path: str | Path) -> None:
    """Write the rendered vehicle as a PNG; ValueError if no off-screen backend works, or for another suffix."""
    if Path(path).suffix.lower() != ".png":
        raise ValueError(f"{path}: a picture's name must end in .png")
    chosen = os.environ.get("MUJOCO_GL")
    for backend in (chosen,) if chosen else ("egl", "osmesa"):
        environment = {**os.environ, "MUJOCO_GL": backend}
        command = [sys.executable, "-c", CHILD, str(path)]
        if subprocess.run(command, env=environment, capture_output=True, check=False).returncode == 0:
            return
    raise ValueError(
        "no off-screen renderer works here: install the system package libosmesa6 or libegl1 "
        "(set MUJOCO_GL to osmesa or egl to choose one)"
    )


def render(path: str) -> None:
    import mujoco

    from hybrid_jax.sim.scene import build_model
    from hybrid_jax.vehicle import IRIS

    model = build_model(IRIS)
    data = mujoco.MjData(model)
    data.qpos[:7] = POSE
    mujoco.mj_forward(model, data)
    with mujoco.Renderer(model, HEIGHT, WIDTH) as renderer:
        renderer.update_scene(data, camera="portrait")
        matplotlib.image.imsave(path, renderer.render())
