"""Print how often our prose uses words that read as translated, beside diffrax and equinox: python tests/words.py"""

import ast
import re
from importlib.util import find_spec
from pathlib import Path

ROOT = Path(__file__).parents[1]
ROWS = r"that of, those of=(that|those) of|alone|hold(s)=holds?|tell(s)=tells?|refuse=refuse[sd]?|in place of"
ROWS += r"|as of, as it is=as (of|it is)|you=you(r|rs)?|for example, e.g.=for example|should|instead|note that"
WORDS = [row.rpartition("=") for row in re.split(r"\|(?![^(]*\))", ROWS)]


def docstrings(folder):
    for path in Path(folder).rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef):
                yield ast.get_docstring(node) or ""


def pages():
    """Prose without code, of all pages but the reports."""
    for path in [ROOT / "README.md", *(ROOT / "docs").rglob("*.md")]:
        if "reference" not in path.parts:
            yield re.sub(r"^```.*?^```|`[^`]*`|\]\([^)]*\)", " ", path.read_text(), flags=re.DOTALL | re.MULTILINE)


if __name__ == "__main__":
    peers = [text for name in ("diffrax", "equinox") for text in docstrings(Path(find_spec(name).origin).parent)]
    ours = docstrings(ROOT / "hybrid_jax")
    texts = ["\n".join(each).lower().replace("e.g.", "for example") for each in (pages(), ours, peers)]
    counts = [len(re.findall(r"[^\W\d_]+", text)) for text in texts]
    print(f"{'per 10 000 words of':22}{'our pages':>12}{'docstrings':>12}{'peers':>12}")
    print(f"{'(words)':22}" + "".join(f"{count:12d}" for count in counts))
    for name, _, word in WORDS:
        rates = (1e4 * len(re.findall(rf"\b({word})\b", text)) / n for text, n in zip(texts, counts, strict=True))
        print(f"{name or word:22}" + "".join(f"{rate:12.1f}" for rate in rates))
