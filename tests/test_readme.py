"""What the README shows is what happens."""

import json
import os
import re
import tomllib
from importlib import import_module

import pytest
from smoke import ROOT, script, unbegun

import hybrid_jax
from experiments.paper.regret import AUTO, of_each_case, over
from experiments.reporting.results import Results

README = (ROOT / "README.md").read_text()
LINES, EXAMPLE = 110, 20  # at most: of the page, and of code in the example


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


def test_it_is_read_in_a_minute():
    assert len(README.splitlines()) <= LINES
    (code,) = re.findall(r"```python\n(.*?)```", README, flags=re.DOTALL)
    assert len([line for line in code.splitlines() if line.strip()]) <= EXAMPLE


@pytest.mark.parametrize("page", ["README.md", "CONTRIBUTING.md", "CHANGELOG.md"])
def test_its_links_lead_somewhere(page):
    """Those of the site are checked by `mkdocs build --strict`."""
    targets = re.findall(r"\]\(([^)#]+)", (ROOT / page).read_text())
    assert [target for target in targets if "://" not in target and not (ROOT / target).exists()] == []


def test_its_table_is_that_of_the_report():
    report = json.loads((ROOT / "docs/reference/changes/report.json").read_text())
    lines = [[cell.strip(" *") for cell in line.split("|")[2:-1]] for line in README.splitlines() if line[:2] == "| "]
    expected = []
    for own in Results(report["rows"], report["tags"]).group("domain").values():
        rho = 1 - over(own, "source")
        errors = [of_each_case(own, name).mean() for name in ("source", "fine_tune", AUTO)]
        expected.append([*(f"{error:.3g}" for error in errors), f"{rho.mean():.3g}, {rho.min():.3g}"])
    assert [line for line in lines if line in expected] == expected
