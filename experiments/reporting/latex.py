"""Tables for a paper: each as a `tabular` of the package booktabs, for any LaTeX."""

import re

from experiments.reporting.tables import Table, best_cells

SPECIAL = {character: f"\\{character}" for character in "&%$#_{}"}
SPECIAL |= {"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "<": "$<$", ">": "$>$"}
MATHEMATICS = {
    "±": r"\pm", "∞": r"\infty", "−": "-", "×": r"\times", "≤": r"\le", "≥": r"\ge", "→": r"\to", "Σ": r"\Sigma",
    "θ": r"\theta", "ρ": r"\rho", "λ": r"\lambda", "ω": r"\omega", "φ": r"\varphi", "Δ": r"\Delta", "β": r"\beta",
    "∂": r"\partial", "✓": r"\checkmark", "✗": r"\times", "²": "^2", "³": "^3", "‖": r"\|",
    "½": r"\frac12", "°": r"^\circ",
}  # fmt: skip
TEXT = {"–": "--", "…": r"\dots{}", "\N{COMBINING DOT ABOVE}": "", "\N{COMBINING CIRCUMFLEX ACCENT}": "", "ö": r"\"o"}


def latex(table: Table) -> str:
    """The table with the best numbers in bold, and its title as a comment; it needs booktabs and amssymb."""
    best = best_cells(table)
    lines = [" & ".join(map(escaped, table.header)) + r" \\", r"\midrule"]
    for i, line in enumerate(table.lines):
        cells = (rf"\textbf{{{escaped(text)}}}" if (i, j) in best else escaped(text) for j, text in enumerate(line))
        lines.append(" & ".join(cells) + r" \\")
    body = "\n".join(lines)
    begin = rf"\begin{{tabular}}{{{'l' * len(table.header)}}}"
    return f"% {table.title}\n{begin}\n\\toprule\n{body}\n\\bottomrule\n\\end{{tabular}}\n"


def escaped(text: str) -> str:
    mathematics = {character: f"${symbol}$" for character, symbol in MATHEMATICS.items()}
    return text.translate(str.maketrans(SPECIAL | mathematics | TEXT))


def file_name(table: Table) -> str:
    """A file's name from the words of a title outside of brackets."""
    words = re.sub(r"\([^)]*\)|\[[^]]*\]|;.*", "", table.title).lower()
    return re.sub(r"[^a-z0-9]+", "_", words).strip("_") or "table"
