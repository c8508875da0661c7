"""Pages show what happens; the site needs neither a server nor the network, and has an entry for every public name."""

import os
import re
import runpy
import shutil
import sys
import zlib
from importlib import import_module, util
from pathlib import Path

import pytest
from browser import BROWSER, PREFIX, visit
from smoke import LEFT, ROOT, script
from test_documentation import PACKAGES
from test_layers import ORDER

DOCS = ROOT / "docs"


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


def test_the_picture_of_layers_is_that_of_the_imports_and_the_menu_has_some_thirty_entries():
    text = (DOCS / "architecture.md").read_text()
    layers = [re.findall(r"`(\w+)`", line.split("|")[1]) for line in text.splitlines() if line.startswith("| `")]
    assert [name for layer in layers for name in layer] == [*reversed(ORDER)]
    _, menu = (ROOT / "mkdocs.yml").read_text().split("\nnav:\n")
    assert 25 <= len(re.findall(r"\.\w+$", menu, flags=re.MULTILINE)) <= 32


@pytest.mark.parametrize("page", written(), ids=lambda page: page.stem)
def test_no_line_of_code_scrolls_and_what_belongs_to_an_item_is_indented_by_four(page):
    """Otherwise the list ends there, and the next item is set as a part of a paragraph."""
    code = re.findall(r"^```\w+\n(.*?)^```", page.read_text(), flags=re.DOTALL | re.MULTILINE)
    # Programs and notebooks have the same limit in docs/ruff.toml.
    assert [line for block in code for line in block.splitlines() if len(line) > 78] == []
    assert re.findall(r"\n\n {1,3}[^ \n].*|\n\n {4}[^`\n]*\n(?: {4}.*\n)*(?:-|\d+\.) .*", page.read_text()) == []


NOTEBOOKS = sorted(DOCS.glob("tutorials/*.ipynb"))


@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda path: path.stem)
def test_every_exercise_has_an_answer(notebook):
    text = notebook.read_text()
    assert text.count("## Exercise") == text.count("<summary>Answer") == 1


@pytest.mark.parametrize("page", written("results"), ids=lambda page: page.stem)
def test_a_summary_of_results_is_one_screen_with_one_figure(page):
    text = page.read_text()
    assert (len(text.splitlines()) <= 46, text.count("![")) == (True, 1)


FOLDER = DOCS / "examples"
PROGRAMS = sorted(FOLDER.glob("*.py"))


def test_the_gallery_shows_all_programs_and_notebooks():
    page = (FOLDER / "index.md").read_text()
    assert {*re.findall(r"\(\.\./(tutorials/\w+\.ipynb)\)", page)} == {f"tutorials/{path.name}" for path in NOTEBOOKS}
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


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """Built with --strict: a page, a link or an anchor that is missing ends it."""
    pytest.importorskip("mkdocs")
    if LEFT is not None:
        return Path(LEFT) / "site"
    folder = tmp_path_factory.mktemp("site")
    more = {"PYTHONPATH": str(ROOT), "HYBRID_JAX_EXECUTE": "false", "SITE_URL": f"http://host{PREFIX}"}
    script("-m", "mkdocs", "build", "--strict", "--site-dir", folder, env=os.environ | more)
    return folder


@pytest.mark.slow
def test_every_public_name_has_an_entry(site):
    inventory = zlib.decompress((site / "objects.inv").read_bytes().split(b"zlib.\n", 1)[1]).decode()
    entries = {line.split(" ")[0] for line in inventory.splitlines()}
    for package in PACKAGES:
        for name in (name for name in import_module(package).__all__ if not name.startswith("_")):
            # `rigid_body` has the name of its module.
            assert {f"{package}.{name}", f"hybrid_jax.dynamics.{name}.{name}"} & entries, f"{package}.{name}"


MEASURE = """(page, window) => {
  const right = Math.min(page.querySelector(".md-content")?.getBoundingClientRect().right ?? 1e9, window.innerWidth)
  const frames = [...page.querySelectorAll("table")].map(table => table.closest(".md-typeset__scrollwrap") ?? table)
  return {
    sideways: page.documentElement.scrollWidth > window.innerWidth,
    tables: frames.filter(frame => frame.getBoundingClientRect().right > right + 1).length,
    formulas: [...page.querySelectorAll(".arithmatex")].filter(
      each => !each.querySelector(".katex-html .base") || each.querySelector(".katex-error")).length,
    cut: [...page.querySelectorAll("div.arithmatex")].filter(each => [...each.querySelectorAll(".mord")].some(
      part => part.getBoundingClientRect().top < each.getBoundingClientRect().top)).length,
    styles: [...page.styleSheets].filter(each => each.href && !each.cssRules.length).length,
    pictures: [...page.images].filter(each => each.complete && !each.naturalWidth).length,
  }
}"""


@pytest.mark.slow
@pytest.mark.skipif(BROWSER is None, reason="no Chromium")
def test_pages_fit_wide_and_narrow_screens_and_need_no_network(site, tmp_path):
    """Also under a path of a host that others share, where an address that leads nowhere shows 404.html."""
    pages = [str(page.relative_to(site)) for page in sorted(site.rglob("*.html"))]
    found, said = visit(site, [*pages, "no/such/page.html"], [1400, 400], MEASURE, tmp_path)
    assert len(found) == 2 * len(pages) + 2
    assert [(page, width, own) for page, width, own in found if any(own.values())] == []
    assert said == []


@pytest.mark.slow
@pytest.mark.skipif(BROWSER is None, reason="no Chromium")
def test_formulas_are_set_in_the_fonts_of_the_site(site, tmp_path):
    formulas = """page => [page.querySelectorAll(".katex-html").length,
      [...page.fonts].some(each => each.family == "KaTeX_Math" && each.status == "loaded")]"""
    ((_, _, (count, loaded)),), _ = visit(site, ["concepts.html"], [1400], formulas, tmp_path)
    written = re.findall(r"\$\$.+?\$\$|\$.+?\$", (DOCS / "concepts.md").read_text(), flags=re.DOTALL)
    assert (count, loaded) == (len(written), True)
