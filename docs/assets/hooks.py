"""What mkdocs does beyond its plugins: MathML, changes, names, 404.html."""

import html
import io
import re
from importlib import import_module, resources
from pathlib import Path
from urllib.parse import urlsplit

from fontTools import subset
from latex2mathml.converter import convert
from mkdocs.structure.files import File

FORMULA = re.compile(
    r'<(span|div) class="arithmatex">\s*\\[(\[](.*?)\\[)\]]\s*</\1>',
    re.DOTALL,
)
# Code and tags, which stay as they are, or a letter with an index.
INDEXED = re.compile(
    r"<(code|pre|math|script|style)\b.*?</\1>|<[^>]*>|"
    r"(?<![\w/.])([^\W\d_]\u0302?)(?:\^([ST]))?"
    r"_([Dipdkmtuvxyz0]|up|down|MSE|reg)(?![a-zA-Z0-9_])",
    re.DOTALL,
)
# Without `stretchy="false"` a norm is as high as its whole line.
NORM, FIXED = "<mo>&#x02016;", '<mo stretchy="false">&#x02016;'
# The sign of a number, not a difference: no space behind it.
SIGN = re.compile(r"(&#x0(?:003D|003C|2264|2265);</mo><mo)>&#x02212;")
# Letters, which browsers set as italics, accents, punctuation, operators.
SIGNS = (
    "20-7E,A0-FF,2B0-36F,370-3FF,2010-205F,2100-214F,2190-22FF,2308-230B,"
    "27E8-27EB,1D434-1D467,1D6E2-1D71B"
)
ROOT = Path(__file__).parents[2]


def on_files(files, config):
    """Add the list of changes, which lies beside README.md, and a font."""
    text = (ROOT / "CHANGELOG.md").read_text().replace("](docs/", "](../")
    files.append(File.generated(config, "about/changes.md", content=text))
    name = "assets/formulas.woff"
    files.append(File.generated(config, name, content=font()))
    return files


def font():
    """Return the part of ziamath's font that formulas need, as WOFF."""
    source = resources.files("ziamath") / "fonts/STIXTwoMath-Regular.ttf"
    options = subset.Options(
        flavor="woff",
        hinting=False,
        layout_features=["ssty"],  # smaller signs for indices
        name_IDs=[0, 1, 2, 13, 14],  # with the licence
    )
    part = subset.load_font(io.BytesIO(source.read_bytes()), options)
    subsetter = subset.Subsetter(options)
    subsetter.populate(unicodes=subset.parse_unicodes(SIGNS))
    subsetter.subset(part)
    file = io.BytesIO()
    subset.save_font(part, file, options)
    return file.getvalue()


def on_page_markdown(markdown, page, config, files):
    """Add all public names to the first page of the reference, sorted."""
    if page.file.src_uri != "api/index.md":
        return markdown
    packages = (
        f"hybrid_jax.{path.parent.name}"
        for path in sorted((ROOT / "hybrid_jax").glob("*/__init__.py"))
    )
    names = {
        name: package
        for package in packages
        for name in import_module(package).__all__
    }
    names["rigid_body"] = (
        "hybrid_jax.dynamics.rigid_body"  # as its module is called
    )
    entries = [
        f"[`{name}`][{names[name]}.{name}]"
        for name in sorted(names, key=str.lower)
        if name[0] != "_"
    ]
    return f"{markdown}\n\n## All names\n\n{' · '.join(entries)}\n"


def on_page_content(content, page, config, files):
    """Write formulas as MathML, which needs no script, and set indices."""
    display = {"span": "inline", "div": "block"}

    def formula(found):
        text = html.unescape(found[2]).strip()
        math = convert(text, display=display[found[1]]).replace(NORM, FIXED)
        return SIGN.sub(r'\1 form="prefix">&#x02212;', math)

    def indexed(found):
        if found[2] is None:
            return found[0]
        above = f"<sup>{found[3]}</sup>" if found[3] else ""
        return f"<i>{found[2]}</i>{above}<sub>{found[4]}</sub>"

    return INDEXED.sub(indexed, FORMULA.sub(formula, content))


def on_post_template(output_content, template_name, config):
    """Tell lost visitors where to go on."""
    if template_name != "404.html":
        return output_content
    home = f"{urlsplit(config.site_url or '').path.rstrip('/')}/index.html"
    return output_content.replace(
        "<h1>404 - Not found</h1>",
        "<h1>This page does not exist</h1><p>It may have moved. Search for "
        f'it, or begin at the <a href="{home}">first page</a>.</p>',
    )
