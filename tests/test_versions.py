"""The lowest versions that pyproject.toml promises are those with which continuous integration runs the wheel."""

import tomllib
from pathlib import Path

from packaging.requirements import Requirement
from packaging.version import Version

ROOT = Path(__file__).parents[1]


def test_ci_installs_the_lowest_version_of_each_requirement():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    pins = map(Requirement, filter(None, (line.partition("#")[0].strip() for line in (ROOT / ".ci/lowest.txt").open())))
    installed = {pin.name: Version(next(iter(pin.specifier)).version) for pin in pins}
    for requirement in map(Requirement, project["dependencies"] + project["optional-dependencies"]["cli"]):
        lowest = [each.version.removesuffix(".*") for each in requirement.specifier if each.operator in (">=", "==")]
        assert [installed[requirement.name]] == list(map(Version, lowest)), requirement.name
