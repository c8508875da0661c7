"""Each program of the gallery runs, is short, and draws the picture that the page shows."""

import re
import runpy
import shutil

import pytest
from smoke import ROOT

FOLDER = ROOT / "docs/examples"
PROGRAMS = sorted(FOLDER.glob("*.py"))
LINES = 60


def test_the_gallery_shows_all_programs():
    page = (FOLDER / "index.md").read_text()
    names = {path.stem for path in PROGRAMS}
    assert len(names) == 12
    assert {*re.findall(r"\]\((\w+)\.png\)", page)} == {*re.findall(r'--8<-- "docs/examples/(\w+)\.py"', page)} == names
    assert all((FOLDER / f"{name}.png").stat().st_size < 60_000 for name in names)
    assert max(len(path.read_text().splitlines()) for path in PROGRAMS) <= LINES


@pytest.mark.slow
@pytest.mark.parametrize("path", PROGRAMS, ids=lambda path: path.stem)
def test_a_program_draws_its_picture(path, tmp_path, monkeypatch):
    shutil.copy(path, tmp_path)
    monkeypatch.chdir(tmp_path)
    runpy.run_path(str(tmp_path / path.name))
    assert (tmp_path / f"{path.stem}.png").exists()
