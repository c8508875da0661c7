"""What the README shows is what happens."""

import os
import re
import tomllib
from importlib import import_module

import pytest
from smoke import ROOT, script, unbegun

import hybrid_jax

README = (ROOT / "README.md").read_text()


@pytest.mark.slow
def test_the_library_example_recovers_the_pendulums_length(tmp_path):
    (code,) = re.findall(r"```python\n(.*?)```", README, flags=re.DOTALL)
    (tmp_path / "example.py").write_text(code)
    said = script("example.py", cwd=tmp_path, env=os.environ | {"PYTHONPATH": str(ROOT)})
    assert said.startswith("Adapted to 20 windows by auto: converged")
    (length,) = re.findall(r"\nlength (\S+)\n", said)
    # Damping pulls at the length until the network has taken it over; 3 % is far inside what a wrong sign would do.
    assert abs(float(length) / 0.8 - 1) < 0.03


def test_the_names_that_it_gives_are_there():
    names = set(re.findall(r"`(hybrid_jax(?:\.\w+)+)[`(]", README))
    assert "hybrid_jax.runtime.configure" in names
    assert all(hasattr(hybrid_jax, name) for name in re.findall(r"`hj\.(\w+)", README))
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
