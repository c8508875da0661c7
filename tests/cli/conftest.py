"""The script in this process, and as installed from the wheel; logs of every format; a browser that looks at pages."""

import os
import subprocess
import sys
import venv
from importlib.metadata import version
from pathlib import Path
from unittest import mock

import pytest
from browser import BROWSER, visit
from packaging.version import Version
from recorded import READING, of_every_format, simulated, written
from smoke import ROOT
from writers import MAP

from experiments.real_flight.simulated import vehicle_toml
from hybrid_jax.cli import main
from hybrid_jax.sim import PARAMETER_SHIFT, SOURCE
from hybrid_jax.vehicle import IRIS

# All is unfolded before it is measured.
MEASURE = """(page, window) => {
  for (const each of page.querySelectorAll("details")) each.open = true
  const hidden = [...page.images].filter(one => one.naturalWidth * one.getBoundingClientRect().height == 0).length
  return {images: page.images.length, hidden, wide: page.documentElement.scrollWidth > window.innerWidth}
}"""


@pytest.fixture(scope="session", autouse=True)
def devices():
    """Devices of this process are fixed by now."""
    with mock.patch("hybrid_jax.cli.command.configure"):
        yield


@pytest.fixture
def called(capsys):
    """The exit code, stdout and stderr of a command line."""

    def call(*arguments):
        with pytest.raises(SystemExit) as stop:
            main([*map(str, arguments)])
        return (stop.value.code or 0, *capsys.readouterr())

    return call


@pytest.fixture
def seen(tmp_path):
    """What a browser shows of pages, at the width of a telephone and of a screen."""

    def look(pages):
        if BROWSER is None:
            pytest.skip("no Chromium")
        (tmp_path / "browser").mkdir()
        for name, page in {"404": "", **pages}.items():
            (tmp_path / f"{name}.html").write_text(page)
        found, said = visit(tmp_path, [f"{name}.html" for name in pages], [400, 1400], MEASURE, tmp_path / "browser")
        assert said == []
        return {(page.removesuffix(".html"), width): shown for page, width, shown in found}

    return look


@pytest.fixture(scope="session")
def script(tmp_path_factory):
    """The script of the wheel, in an environment that sees the packages of this one, and nothing of the checkout."""
    folder = tmp_path_factory.mktemp("wheel")
    (folder / "build.cfg").write_text(f"[build]\nbuild_base = {folder / 'build'}\n")  # not in the checkout
    build = [sys.executable, "-m", "pip", "wheel", "-q", "--no-deps", "-w", folder, ROOT]
    if Version(version("setuptools")) >= Version("77"):  # else pip loads one
        build.append("--no-build-isolation")
    subprocess.run(build, check=True, env=os.environ | {"DIST_EXTRA_CONFIG": str(folder / "build.cfg")})
    venv.create(folder / "env", system_site_packages=True, symlinks=True)
    site = next((folder / "env").glob("lib/python*/site-packages"))
    (site / "parent.pth").write_text("\n".join(path for path in sys.path if path.endswith("site-packages")))
    (wheel,) = folder.glob("*.whl")
    python = folder / "env" / "bin" / "python"
    install = [python, "-m", "pip", "install", "-q", "--no-deps", "--no-index", "--force-reinstall", wheel]
    subprocess.run(install, check=True, env={}, cwd=folder)
    where = [python, "-c", "import hybrid_jax; print(hybrid_jax.__file__)"]
    found = subprocess.run(where, capture_output=True, text=True, env={}, cwd=folder).stdout
    assert Path(found.strip()).is_relative_to(folder)
    return python.with_name("hybrid-jax")


@pytest.fixture(scope="session")
def ran(script):
    """What a command line of the script of the wheel prints, run in a folder."""

    def run(folder, line):
        environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
        given = [script, *line.split()]
        done = subprocess.run(given, capture_output=True, text=True, env=environment, cwd=folder)
        assert done.returncode == 0, done.stderr
        return done.stdout

    return run


@pytest.fixture(scope="session")
def fitted(tmp_path_factory, ran):
    """Flights of every format, a model of them by the script of the wheel, and flights after a change of inertia."""
    root = tmp_path_factory.mktemp("cli")
    (root / "v.toml").write_text(vehicle_toml(IRIS))
    (root / "map.toml").write_text(MAP)
    of_every_format(root / "before", simulated(SOURCE, 5, 0))
    written(root / "after", PARAMETER_SHIFT, 2, 1)
    ran(root, f"fit before -o source.npz --vehicle v.toml {READING}")
    return root
