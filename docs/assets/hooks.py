"""What mkdocs does beyond its plugins: KaTeX, changes, names, 404.html."""

import re
from importlib import import_module, resources
from pathlib import Path
from urllib.parse import urlsplit

from mkdocs.structure.files import File

# Formulas, code and tags, which stay as they are, or a letter with an index.
INDEXED = re.compile(
    r'<(span|div) class="arithmatex">.*?</\1>|'
    r"<(code|pre|script|style)\b.*?</\2>|<[^>]*>|"
    r"(?<![\w/.])([^\W\d_]\u0302?)(?:\^([ST]))?"
    r"_([Dipdkmtuvxyz0]|up|down|MSE|reg)(?![a-zA-Z0-9_])",
    re.DOTALL,
)
# KaTeX as its authors publish it, in a package that also is a plugin of
# Django CMS, of which nothing runs here.
PACKAGE = "djangocms_katex"
KATEX = resources.files(PACKAGE) / "static" / PACKAGE / "vendor/katex"
ROOT = Path(__file__).parents[2]


def on_files(files, config):
    """Add the list of changes, which lies beside README.md, and KaTeX."""
    text = (ROOT / "CHANGELOG.md").read_text().replace("](docs/", "](../")
    files.append(File.generated(config, "about/changes.md", content=text))
    parts = [KATEX / f"katex.min.{end}" for end in ("js", "css")]
    parts += [KATEX / "LICENSE", *(KATEX / "fonts").iterdir()]
    for part in parts:
        if part.name.endswith((".ttf", ".woff")):
            continue  # for browsers older than woff2
        folder = "assets/katex/fonts" if "_" in part.name else "assets/katex"
        name = f"{folder}/{part.name}"
        files.append(File.generated(config, name, content=part.read_bytes()))
    return files


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
    """Set letters with an index that are no formula."""

    def indexed(found):
        if found[3] is None:
            return found[0]
        above = f"<sup>{found[4]}</sup>" if found[4] else ""
        return f"<i>{found[3]}</i>{above}<sub>{found[5]}</sub>"

    return INDEXED.sub(indexed, content)


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
