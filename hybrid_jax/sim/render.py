"""A picture of the vehicle (Fig. 6). `python -m hybrid_jax.sim.render FILE.png` draws it with MuJoCo's own renderer.

MuJoCo chooses its OpenGL when it is first imported, so `picture` draws in a process of its own and tries one way after
the other.
"""

# MuJoCo's compiled modules carry no type stubs.
# pyright: reportAttributeAccessIssue=false

import os
import subprocess
import sys
from pathlib import Path

WIDTH, HEIGHT = 1600, 1200  # pixels
WAYS = ("egl", "osmesa")
ALTITUDE = 0.30  # m
ATTITUDE = (0.995, -0.04, 0.07, 0.05)  # (w, x, y, z), not quite unit; MuJoCo normalises it


def picture(path: str | Path) -> None:
    """Write the rendered vehicle as a PNG of 1600 × 1200 pixels.

    Raises:
        ValueError: the name does not end in .png, or this machine cannot draw without a screen; says what to install.
    """
    if Path(path).suffix.lower() != ".png":
        raise ValueError(f"{path}: a picture's name must end in .png")
    chosen = os.environ.get("MUJOCO_GL")
    for way in (chosen,) if chosen else WAYS:
        environment = {**os.environ, "MUJOCO_GL": way}
        command = [sys.executable, "-m", "hybrid_jax.sim.render", str(path)]
        if subprocess.run(command, env=environment, capture_output=True, check=False).returncode == 0:
            return
    raise ValueError(
        f"{path}: no renderer without a screen works here: install the system package libosmesa6 or libegl1 "
        "(set MUJOCO_GL to osmesa or egl to insist on one)"
    )


def draw(path: str | Path) -> None:
    """Render in this process, with the OpenGL that MUJOCO_GL names."""
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


def main(arguments: list[str]) -> int:
    """The command line: draw, here where MUJOCO_GL says how, otherwise in whichever way works. Exit code 2 and one line
    if none does."""
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
