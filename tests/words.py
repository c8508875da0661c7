"""How often our prose uses words that read as translated, beside diffrax and equinox: python tests/words.py

It prints occurrences per 10 000 words of pages and docstrings, and asserts nothing.
"""

import ast
import re
from importlib.util import find_spec
from pathlib import Path

ROOT = Path(__file__).parents[1]
WORDS = {
    "that of, those of": r"\b(that|those) of\b",
    "alone": r"\balone\b",
    "hold(s)": r"\bholds?\b",
    "tell(s)": r"\btells?\b",
    "refuse": r"\brefuse[sd]?\b",
    "as of, as it is": r"\bas (of|it is)\b",
    "in place of": r"\bin place of\b",
    "you": r"\byou(r|rs)?\b",
    "for example, e.g.": r"\bfor example\b|\be\.g\.",
    "should": r"\bshould\b",
    "instead": r"\binstead\b",
    "note that": r"\bnote that\b",
}


def docstrings(folder):
    for path in Path(folder).rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef):
                yield ast.get_docstring(node) or ""


def pages():
    """Prose without code, of all pages but the reports."""
    for path in [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]:
        if "reference" not in path.parts:
            yield re.sub(r"^```.*?^```|`[^`]*`|\]\([^)]*\)", " ", path.read_text(), flags=re.DOTALL | re.MULTILINE)


def rates(texts):
    text = "\n".join(texts).lower()
    count = len(re.findall(r"[^\W\d_]+", text))
    return [count, *(1e4 * len(re.findall(pattern, text)) / count for pattern in WORDS.values())]


def main():
    peers = [text for name in ("diffrax", "equinox") for text in docstrings(Path(find_spec(name).origin).parent)]
    columns = [rates(pages()), rates(docstrings(ROOT / "hybrid_jax")), rates(peers)]
    print(f"{'per 10 000 words':22}{'our pages':>12}{'docstrings':>12}{'peers':>12}")
    for name, *values in zip(("words", *WORDS), *columns, strict=True):
        print(f"{name:22}" + "".join(f"{value:12.1f}" for value in values))


if __name__ == "__main__":
    main()
