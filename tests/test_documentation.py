"""`help()` tells a reader everything: each public name, field and argument is described where Python sees it."""

import dataclasses
import inspect
import re
from collections.abc import Iterator
from importlib import import_module
from types import ModuleType

from smoke import ROOT

PACKAGES = ["hybrid_jax", *sorted(f"hybrid_jax.{p.parent.name}" for p in (ROOT / "hybrid_jax").glob("*/__init__.py"))]
# Of a vector field ẋ = f(x, u) the state and the input, and the random key, are the same everywhere.
KNOWN = {"self", "cls", "key", "x", "u"}


def public() -> Iterator[tuple[str, object]]:
    """The public names, each with its module: of all packages, and those that the page of other modules lists."""
    page = (ROOT / "docs/api/modules.md").read_text()
    listed = re.findall(r"^::: (\S+)\n.*members: \[(.*?)\]", page, flags=re.MULTILINE)
    names = {module: re.split(r",\s*", members) for module, members in listed}
    for module in map(import_module, [*PACKAGES, *names]):
        for name in names.get(module.__name__) or getattr(module, "__all__", ()):
            found = getattr(module, name)
            if not name.startswith("_") and not isinstance(found, ModuleType):
                yield getattr(found, "__module__", module.__name__), found


def described(doc: str | None, *sections: str) -> set[str]:
    """The names with an entry in sections of a docstring in Google's style."""
    names, inside = set(), False
    for line in inspect.cleandoc(doc or "").splitlines():
        if line[:1].strip():  # not indented
            inside = line.strip() in {f"{section}:" for section in sections}
        elif inside and (entry := re.match(r" {4}(\*{0,2}\w+(?:, \w+)*):(?: +\S|$)", line)):
            names |= {name.strip(" *") for name in entry[1].split(",")}
    return names


def missing(found: object) -> list[str]:
    """What of a class or function has no description."""
    if not (inspect.isclass(found) or hasattr(found, "__name__")):
        return []  # a constant
    name = found.__name__
    return [f"{name}{part}" for part in (missing_of_class if inspect.isclass(found) else missing_of_function)(found)]


def missing_of_function(function: object, doc: str | None = None, known: Iterator[str] = ()) -> list[str]:
    doc = doc or inspect.getdoc(function)
    arguments = {name: one for name, one in inspect.signature(function).parameters.items() if not name.startswith("_")}
    named = described(doc, "Args") | KNOWN | set(known)
    lost = ([] if doc else [": docstring"]) + [f": {name}" for name in arguments if name not in named]
    # The site's build warns of these, and ends.
    own = described(getattr(function, "__doc__", None), "Args") & arguments.keys()
    return lost + [f": annotation of {name}" for name in sorted(own) if arguments[name].annotation is inspect._empty]


def missing_of_class(kind: type) -> list[str]:
    own = [base for base in kind.__mro__ if base.__module__.startswith("hybrid_jax")]
    known = {name for base in own for name in described(vars(base).get("__doc__"), "Attributes", "Args")}
    doc = vars(kind).get("__doc__") or ""
    fields = [one.name for one in dataclasses.fields(kind)] if dataclasses.is_dataclass(kind) else []
    fields = [name for name in (*fields, *getattr(kind, "_fields", ())) if not name.startswith("_")]
    # Dataclasses and named tuples are given a signature where they have no docstring.
    lost = [": docstring"] if not doc or doc.startswith(f"{kind.__name__}(") else []
    lost += [f".{name}" for name in fields if name not in known]
    if inspect.isfunction(vars(kind).get("__init__")) and not getattr(kind, "_is_protocol", False):
        lost += [f".__init__{part}" for part in missing_of_function(kind.__init__, "", known | set(fields))[1:]]
    for name, member in vars(kind).items():
        theirs = [base for base in kind.__mro__[1:] if name in vars(base)]  # that it overrides
        if name.startswith("_") or name in fields or any(base not in own for base in theirs):
            continue
        if isinstance(member, property):
            lost += [] if inspect.getdoc(getattr(kind, name)) else [f".{name}: docstring"]
        elif inspect.isroutine(function := getattr(member, "__func__", member)):
            known_above = {entry for base in theirs for entry in described(inspect.getdoc(vars(base)[name]), "Args")}
            doc = inspect.getdoc(function) or next((inspect.getdoc(vars(base)[name]) for base in theirs), None)
            lost += [f".{name}{part}" for part in missing_of_function(function, doc, known_above)]
    return lost


def test_every_public_name_field_and_argument_is_described():
    lost: dict[str, list[str]] = {}
    for module, found in public():
        if module.startswith("hybrid_jax"):
            lost.setdefault(module, [])
            lost[module] += [part for part in missing(found) if part not in lost[module]]
    assert {module: parts for module, parts in lost.items() if parts} == {}
