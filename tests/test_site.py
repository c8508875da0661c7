"""The site: a folder that needs neither a server nor the network, with an entry for every public name."""

import os
import re
import zlib
from importlib import import_module
from pathlib import Path

import pytest
from browser import BROWSER, PREFIX, visit
from smoke import LEFT, ROOT, script
from test_documentation import PACKAGES


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


@pytest.mark.slow
def test_pages_load_only_what_is_in_the_folder(site):
    for page in site.rglob("*.html"):
        tags = re.findall(r"<(?:script|img|iframe|link)\b[^>]*>", page.read_text())
        loaded = [re.findall(r"\b(?:src|href)=\"?([^\" >]*)", tag) for tag in tags if 'rel="canonical"' not in tag]
        for target in (target.partition("#")[0] for found in loaded for target in found):
            # The page for lost visitors of a server has absolute paths.
            place = site / target.removeprefix(PREFIX) if target.startswith("/") else page.parent / target
            assert target[:5] == "data:" or place.exists(), f"{page}: {target}"


MEASURE = """(page, window) => {
  const right = Math.min(page.querySelector(".md-content")?.getBoundingClientRect().right ?? 1e9, window.innerWidth)
  const frames = [...page.querySelectorAll("table")].map(table => table.closest(".md-typeset__scrollwrap") ?? table)
  return {
    sideways: page.documentElement.scrollWidth > window.innerWidth,
    tables: frames.filter(frame => frame.getBoundingClientRect().right > right + 1).length,
    formulas: [...page.querySelectorAll("math")].filter(each => each.getBoundingClientRect().height < 3).length,
    source: page.querySelectorAll(".arithmatex").length,
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
