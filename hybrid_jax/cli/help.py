"""Print `--help`, with a line or two for each common option. For `--help-all`, tyro lists all of them."""

import ast
import inspect
import re
import shutil
import textwrap
from collections.abc import Collection
from dataclasses import MISSING, fields, is_dataclass
from itertools import pairwise
from types import NoneType
from typing import Annotated, Any, Literal, cast, get_args, get_origin, get_type_hints

import tyro

RARE = "rare"  # annotation of an option that only --help-all lists
INDENT, WIDEST, LONG = 26, 100, 15  # columns; choices that are longer follow the text
VALUES: dict[Any, str] = {bool: "", int: "N", float: "X", str: "NAME"}
WORDS = {"N": "an integer", "X": "a number"}


def short_help(kind: type, program: str, about: str, default: Any, common: Collection[str] | None) -> str:
    """Return the help on options of a dataclass: those in `common`, or all without RARE in their annotation.

    It has the first paragraph of the program's description, and the first sentence of each option's.
    """
    texts, hints = _documented(kind), get_type_hints(kind, include_extras=True)
    every = [each for each in fields(cast(Any, kind)) if tyro.conf.Suppress not in _marks(hints[each.name])]
    options: list[tuple[int, str, str]] = []
    for each in every:
        marks = _marks(hints[each.name])
        if RARE in marks if common is None else each.name not in common:
            continue
        value = each.default if default is None else getattr(default, each.name)
        typed, more, _ = values(hints[each.name]).partition(" …")
        sentence = re.split(r"(?<=\.)\s", " ".join(texts[each.name].split()))[0].removesuffix(".")
        shown = " ".join(map(str, value)) if isinstance(value, tuple) else str(value)
        if len(typed) > LONG:
            sentence, typed = f"{sentence}: {typed.replace('|', ', ')}", "NAME"
        elif not (value is None or isinstance(value, bool) or value in ((), MISSING)):
            sentence += f" [{shown}]"
        named = f"--{'no-' * (value is True)}{option_of(each.name, marks)} {typed}{more}".rstrip()
        aliases = [alias for mark in marks for alias in getattr(mark, "aliases", None) or ()]
        needed = value is MISSING and each.default_factory is MISSING
        place = 0 if tyro.conf.Positional in marks else 1 if needed else 2 + (each.name not in kind.__annotations__)
        options.append((place, ", ".join([*aliases, named]) if place else each.name.upper(), sentence))
    options.sort(key=lambda option: option[0])  # arguments, needed options, own ones, inherited ones
    width = min(shutil.get_terminal_size().columns, WIDEST) - 1
    needs = [name.partition(", ")[2] or name for place, name, _ in options if place < 2]
    summary = textwrap.wrap(about.partition("\n\n")[0], width)
    text = [f"usage: {' '.join([program, *needs])} [OPTIONS]", "", *summary, ""]
    for _, name, sentence in options:
        head = f"  {name}".ljust(INDENT)
        text += [head.rstrip()] * (len(head) > INDENT)
        first = " " * INDENT if len(head) > INDENT else head
        text += textwrap.wrap(sentence, width, initial_indent=first, subsequent_indent=" " * INDENT)
    left = len(every) - len(options)
    lists = f", and lists {left} more option{'s' * (left > 1)}" * (left > 0)
    return "\n".join([*text, "", f"--help-all explains more{lists}."])


def _marks(hint: Any) -> tuple[Any, ...]:
    return getattr(hint, "__metadata__", ())


def option_of(name: str, marks: Collection[Any]) -> str:
    """Return the name of a field's option without dashes, which an annotation may set."""
    return next((mark.name for mark in marks if getattr(mark, "name", None) is not None), name.replace("_", "-"))


def _documented(kind: type) -> dict[str, str]:
    """Return the string below each field of a dataclass and of its bases."""
    found: dict[str, str] = {}
    for each in filter(is_dataclass, reversed(kind.__mro__)):
        (body,) = ast.parse(textwrap.dedent(inspect.getsource(cast(Any, each)))).body
        for field, text in pairwise(cast(ast.ClassDef, body).body):
            if isinstance(field, ast.AnnAssign) and isinstance(text, ast.Expr):
                found[ast.unparse(field.target)] = ast.literal_eval(text.value)
    return found


def values(hint: Any) -> str:
    """Return what a user types after an option of this type."""
    origin, args = get_origin(hint), get_args(hint)
    if origin is Annotated:
        return values(args[0])
    if origin is Literal:
        return "|".join(map(str, args))
    if origin is tuple:
        return f"{values(args[0])} …" if ... in args else " ".join(map(values, args))
    if args:
        return "|".join(values(each) for each in args if each is not NoneType)
    return VALUES.get(hint, "PATH")


def expected(typed: str) -> str:
    """Describe in words what a user should type after an option, from the result of `values`."""
    typed, many, _ = typed.partition(" …")
    one, *more = typed.split()
    what = f"one of {one.replace('|', ', ')}" if "|" in one else WORDS.get(one, one)
    several = "" if many else f"{1 + len(more)} "
    return f"{several}{what.split()[-1]}s" if (many or more) and one in WORDS else what
