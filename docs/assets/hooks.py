"""What mkdocs does beyond its plugins: mathematics as MathML, which needs no script, and the list of changes."""

import html
import re
from pathlib import Path

from latex2mathml.converter import convert
from mkdocs.structure.files import File

FORMULA = re.compile(r'<(span|div) class="arithmatex">\s*\\[(\[](.*?)\\[)\]]\s*</\1>', re.DOTALL)
ROOT = Path(__file__).parents[2]


def on_files(files, config):
    """Add the list of changes, which lies beside README.md, as a page."""
    text = (ROOT / "CHANGELOG.md").read_text().replace("](docs/", "](../")
    files.append(File.generated(config, "about/changes.md", content=text))
    return files


def on_page_content(content, page, config, files):
    """Replace each formula of the page by MathML, on a line of its own if it was one."""
    display = {"span": "inline", "div": "block"}
    return FORMULA.sub(lambda found: convert(html.unescape(found[2]).strip(), display=display[found[1]]), content)
