"""What the README shows is what happens."""

import re
import subprocess
import sys
import tomllib
from importlib import import_module
from pathlib import Path

from smoke import unbegun

import hybrid_jax

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text()


def test_the_library_example_recovers_the_pendulums_length(tmp_path):
    (code,) = re.findall(r"```python\n(.*?)```", README, flags=re.DOTALL)
    script = tmp_path / "example.py"
    script.write_text(code)
    done = subprocess.run([sys.executable, script], cwd=ROOT, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    length, loss = map(float, re.fullmatch(r"length (\S+) validation loss (\S+)\n", done.stdout).groups())
    # Damping pulls at the length until the network has taken it over; 5 % is far inside what a wrong sign would do.
    assert abs(length / 0.7 - 1) < 0.05
    assert loss < 1e-3


def test_the_names_that_it_gives_are_there():
    names = set(re.findall(r"`(hybrid_jax(?:\.\w+)+)[`(]", README))
    assert {"hybrid_jax.runtime.configure", "hybrid_jax.dynamics.disturbance"} <= names
    assert "runtime" in hybrid_jax.__all__
    for name in names:
        found = hybrid_jax
        for part in name.split(".")[1:]:
            found = getattr(found, part, None) or import_module(f"{found.__name__}.{part}")


def test_the_extras_that_it_names_exist():
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    assert set(re.findall(r"\.\[(\w+)\]", README)) <= set(extras)


def test_every_command_that_it_names_explains_itself():
    commands = set(re.findall(r"python -m experiments\.(\w+)", README))
    assert commands
    for command in commands:
        done = unbegun(command, "--help")
        assert done.returncode == 0
        assert "--out" in done.stdout
