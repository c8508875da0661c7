"""The words of each report, from questions.toml: no code, so that to edit them repeats no run."""

import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple


class Asked(NamedTuple):
    """A report's title, what the result means for you, and the unfolded table and figure, by default the first.

    `head` says what was done, in Markdown.
    """

    question: str
    meaning: Sequence[str] = ()
    table: str = ""
    figure: str = ""
    head: str = ""


_WORDS = tomllib.loads(Path(__file__).with_suffix(".toml").read_text("utf-8"))
QUESTIONS: Mapping[str, Asked] = {name: Asked(**words) for name, words in _WORDS.items()}
