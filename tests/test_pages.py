"""What the pages show is what happens, and each program of the gallery draws its picture."""

import re
import runpy
import shutil
import sys
from importlib import util

import pytest
from smoke import ROOT
from test_layers import ORDER

DOCS = ROOT / "docs"
CODE = 78  # characters of a line of code


def blocks(page):
    return re.findall(r"^```python\n(.*?)^```", page.read_text(), flags=re.DOTALL | re.MULTILINE)


def written(folder="."):
    """The pages that people write: all but reports."""
    return [page for page in sorted((DOCS / folder).rglob("*.md")) if "reference" not in page.parts]


@pytest.mark.slow
@pytest.mark.parametrize("page", [page for page in written() if blocks(page)], ids=lambda page: page.stem)
def test_the_examples_of_a_page_run(page, tmp_path, monkeypatch):
    """As one module, as a user would write it, since a saved model names the module of its classes."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", str(tmp_path))
    # Devices are fixed by now, and other tests keep the flags that they began with.
    monkeypatch.setattr("hybrid_jax.runtime.configure", lambda: None)
    name = f"page_{page.stem}"
    path = tmp_path / f"{name}.py"
    path.write_text("\n".join(blocks(page)))
    spec = util.spec_from_file_location(name, path)
    module = util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, name, module)
    spec.loader.exec_module(module)


def test_the_picture_of_layers_is_that_of_the_imports():
    text = (DOCS / "architecture.md").read_text()
    layers = [re.findall(r"`(\w+)`", line.split("|")[1]) for line in text.splitlines() if line.startswith("| `")]
    assert [name for layer in layers for name in layer] == [*reversed(ORDER)]


@pytest.mark.parametrize("page", written(), ids=lambda page: page.stem)
def test_no_line_of_code_scrolls(page):
    """Programs and notebooks have the same limit in docs/ruff.toml."""
    code = re.findall(r"^```\w+\n(.*?)^```", page.read_text(), flags=re.DOTALL | re.MULTILINE)
    assert [line for block in code for line in block.splitlines() if len(line) > CODE] == []


@pytest.mark.parametrize("page", written(), ids=lambda page: page.stem)
def test_what_belongs_to_an_item_is_indented_by_four(page):
    """Otherwise the list ends there, and the next item is set as a part of a paragraph."""
    assert re.findall(r"\n\n {1,3}[^ \n].*|\n\n {4}[^`\n]*\n(?: {4}.*\n)*(?:-|\d+\.) .*", page.read_text()) == []


@pytest.mark.parametrize("notebook", sorted(DOCS.glob("tutorials/*.ipynb")), ids=lambda path: path.stem)
def test_every_exercise_has_an_answer(notebook):
    text = notebook.read_text()
    assert text.count("## Exercise") == text.count("<summary>Answer") == 1


FOLDER = DOCS / "examples"
PROGRAMS = sorted(FOLDER.glob("*.py"))


def test_the_gallery_shows_all_programs():
    page = (FOLDER / "index.md").read_text()
    names = {path.stem for path in PROGRAMS}
    assert len(names) == 12
    assert {*re.findall(r"\]\((\w+)\.png\)", page)} == {*re.findall(r'--8<-- "docs/examples/(\w+)\.py"', page)} == names
    assert all((FOLDER / f"{name}.png").stat().st_size < 60_000 for name in names)
    assert max(len(path.read_text().splitlines()) for path in PROGRAMS) <= 60


@pytest.mark.slow
@pytest.mark.parametrize("path", PROGRAMS, ids=lambda path: path.stem)
def test_a_program_draws_its_picture(path, tmp_path, monkeypatch):
    shutil.copy(path, tmp_path)
    monkeypatch.chdir(tmp_path)
    runpy.run_path(str(tmp_path / path.name))
    assert (tmp_path / f"{path.stem}.png").exists()
