"""What the README shows is what happens, and the lowest versions are those with which CI runs the wheel."""

import os
import re
import tomllib
from importlib import import_module

import pytest
from packaging.requirements import Requirement
from packaging.version import Version
from smoke import ROOT, script
from test_numbers import committed

import hybrid_jax
from experiments.paper.regret import AUTO, of_each_case

README = (ROOT / "README.md").read_text()
LINES, EXAMPLE = 100, 32  # at most: of the page, and of code in the example


@pytest.mark.slow
def test_the_example_prints_what_it_shows(tmp_path):
    (code,) = re.findall(r"```python\n(.*?)```", README, flags=re.DOTALL)
    (shown,) = re.findall(r"```text\n(.*?)```", README, flags=re.DOTALL)
    (tmp_path / "example.py").write_text(code)
    said = script("example.py", cwd=tmp_path, env=os.environ | {"PYTHONPATH": str(ROOT)})
    expected, found = (dict(re.findall(r"(.+): (\S+) mrad", text)) for text in (shown, said))
    assert found.keys() == expected.keys()
    for name, number in found.items():
        # Another processor rounds differently.
        assert float(number) == pytest.approx(float(expected[name]), rel=0.5), name


def test_the_names_and_extras_that_it_gives_are_there_and_it_is_read_in_a_minute():
    names = set(re.findall(r"`(hybrid_jax(?:\.\w+)+)[`(]", README))
    assert all(hasattr(hybrid_jax, name) for name in re.findall(r"`hj\.(\w+)", README))
    for name in names:
        found = hybrid_jax
        for part in name.split(".")[1:]:
            found = getattr(found, part, None) or import_module(f"{found.__name__}.{part}")
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    assert set(re.findall(r"\.\[(\w+)\]", README)) <= set(extras)
    assert len(README.splitlines()) <= LINES
    (code,) = re.findall(r"```python\n(.*?)```", README, flags=re.DOTALL)
    assert len([line for line in code.splitlines() if line.strip()]) <= EXAMPLE


@pytest.mark.parametrize("page", ["README.md", "CONTRIBUTING.md", "CHANGELOG.md"])
def test_its_links_lead_somewhere(page):
    """Those of the site are checked by `mkdocs build --strict`."""
    targets = re.findall(r"\]\(([^)#]+)", (ROOT / page).read_text())
    assert [target for target in targets if "://" not in target and not (ROOT / target).exists()] == []


def test_its_table_is_that_of_the_reports():
    lines = [[cell.strip(" *") for cell in line.split("|")[2:-1]] for line in README.splitlines() if line[:2] == "| "]
    ways, changes = ("source", "fine_tune", AUTO), committed("changes").where(world="iris").group("domain")
    flight = {domain: [of_each_case(own, way).mean() for way in ways] for domain, own in changes.items()}
    paper, expected = (("hybrid", "source_only"), ("hybrid", "fine_tuned"), ("constant_disturbance", "fine_tuned")), []
    for name, domain in (("param_shift", "parameter_shift"), ("external_force", "external_force")):
        rows = committed(name).where(n_train=(0, 100))
        means = [rows.where(model=model, mode=mode).spread("test_mse").mean for model, mode in paper]
        expected += [means, flight[domain]]
    other = committed("changes/harm").where(world="hummingbird", change="parameter_shift", flight="moving", draw=0)
    other = other.where(seed=tuple(other.where(method="fine_tune").unique("seed")))  # all ways adapted from these
    last = [other.where(method=way).spread("test_mse").median for way in (*ways, "fine_tune_paper")]
    cells = [[f"{mean:.3g}" for mean in means] for means in (*expected, flight["off_centre_load"], last[:3])]
    cells[-1][1] += f"; 1000 clean windows: {last[3]:.2g}"
    assert lines[-6:] == cells


def test_ci_installs_the_lowest_version_of_each_requirement():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    pins = map(Requirement, filter(None, (line.partition("#")[0].strip() for line in (ROOT / ".ci/lowest.txt").open())))
    installed = {pin.name: Version(next(iter(pin.specifier)).version) for pin in pins}
    for requirement in map(Requirement, project["dependencies"] + project["optional-dependencies"]["cli"]):
        lowest = [each.version.removesuffix(".*") for each in requirement.specifier if each.operator in (">=", "==")]
        assert [installed[requirement.name]] == list(map(Version, lowest)), requirement.name
