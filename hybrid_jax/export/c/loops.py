"""Pieces of C: tables of numbers, loops over arrays, and statements of which those that nothing uses are left out."""

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

LOOPED = 8  # so many entries are copied by a loop


@dataclass(frozen=True)
class Entry:
    """A variable, or an entry of an array."""

    name: str
    index: int | None = None
    logical: bool = False  # an int, 0 or 1; else a real

    def __str__(self) -> str:
        return self.name if self.index is None else f"{self.name}[{self.index}]"


@dataclass(frozen=True)
class Statement:
    """Code that defines one variable or array from others."""

    defines: str
    uses: frozenset[str]
    text: str
    array: tuple[str, int] | None = None  # type and size of the array that it defines, which is still to be declared


@dataclass(frozen=True)
class Code:
    """Code with places {0}, {1}, … for operands and {out} for the array that it fills."""

    text: str
    operands: Sequence["Code"] = ()
    uses: frozenset[str] = frozenset()


@dataclass
class Tables:
    """What the functions of a file share: numbers, functions that they call, and names that are not taken."""

    double: bool
    constants: dict[bytes, str] = field(default_factory=dict)  # bytes of the numbers → name
    definitions: dict[str, str] = field(default_factory=dict)  # name → C
    functions: list[str] = field(default_factory=list)  # each after those that it calls
    _count: int = 0

    def name(self, letter: str) -> str:
        """A new name."""
        self._count += 1
        return f"{letter}{self._count}"

    def text(self, value) -> str:
        """An operand in C."""
        if isinstance(value, bool):
            return str(int(value))
        if not isinstance(value, float):
            return str(value)
        if not np.isfinite(value):
            return "((real)NAN)" if value != value else f"((real){'-' if value < 0 else ''}INFINITY)"
        digits = repr(value) if self.double else f"{np.float32(value):.9g}"
        digits = digits if any(mark in digits for mark in ".en") else f"{digits}.0"
        digits += "" if self.double else "f"
        return f"({digits})" if value < 0 else digits

    def filled(self, template: str, operands: Sequence[str], out: str = "") -> str:
        """Code with its operands."""
        return template.format(*operands, out=out, f="" if self.double else "f", r="real")

    def function(self, parameters: Sequence[str], body: str) -> str:
        """The name of a new function."""
        name = self.name("f")
        self.functions.append(f"static void {name}({', '.join(parameters)}) {{\n{body}\n}}\n")
        return name

    def table(self, numbers: np.ndarray) -> str:
        """The name of a table of these numbers."""
        numbers = np.asarray(numbers, float if self.double else np.float32)
        key = numbers.tobytes()
        if key not in self.constants:
            name = self.constants[key] = f"c{len(self.constants)}"
            rows = [", ".join(self.text(float(one)) for one in numbers[i : i + 8]) for i in range(0, len(numbers), 8)]
            body = ",\n    ".join(rows)
            self.definitions[name] = f"static const real {name}[{len(numbers)}] = {{\n    {body}}};"
        return self.constants[key]


def used(entries: Iterable) -> frozenset[str]:
    """The names of variables and arrays among entries."""
    return frozenset(one.name for one in entries if isinstance(one, Entry))


def is_contiguous(entries: np.ndarray) -> bool:
    """Whether these are numbers, or follow each other in one array."""
    if all(isinstance(one, float) for one in entries):
        return True
    places = _places(entries)
    return places is not None and bool((np.diff(places) == 1).all())


def address(tables: Tables, entries: np.ndarray) -> Code:
    """Where contiguous entries begin."""
    first = entries[0]
    if not isinstance(first, Entry):
        return Code(tables.table(entries.astype(float)))
    return Code(f"{first.name} + {first.index}" if first.index else first.name, uses=frozenset((first.name,)))


def indexed(tables: Tables, entries: np.ndarray, shape: tuple[int, ...]) -> Code | None:
    """The entry at the indices i0, i1, … of an array of this shape, or None if its place is not linear in them."""
    first = entries[0]
    if all(one == first for one in entries):
        return Code(tables.text(first), uses=used([first]))
    if all(isinstance(one, float) for one in entries):
        return _in_table(tables, entries.astype(float).reshape(shape))
    if (places := _places(entries)) is None:
        return None
    grid = places.reshape(shape)
    corner = int(grid.flat[0])
    steps = [int(grid.take(1, axis).flat[0]) - corner if size > 1 else 0 for axis, size in enumerate(shape)]
    index = np.indices(shape)
    if not (grid == corner + np.tensordot(steps, index, 1)).all():
        return None
    return Code(f"{first.name}[{_index(corner, steps)}]", uses=frozenset((first.name,)))


def _in_table(tables: Tables, grid: np.ndarray) -> Code:
    """A constant, with one entry in the table along axes on which it does not depend."""
    kept = [bool((grid != grid.take([0], axis)).any()) for axis in range(grid.ndim)]
    core = grid[tuple(slice(None) if keep else slice(0, 1) for keep in kept)]
    strides = [int(np.prod(core.shape[axis + 1 :])) if keep else 0 for axis, keep in enumerate(kept)]
    return Code(f"{tables.table(core.ravel())}[{_index(0, strides)}]")


def _places(entries: np.ndarray) -> np.ndarray | None:
    """The indices of entries that are of one array."""
    first = entries[0]
    if not isinstance(first, Entry) or first.index is None:
        return None
    if any(not isinstance(one, Entry) or one.name != first.name for one in entries):
        return None
    return np.array([one.index for one in entries])


def _index(corner: int, steps: Sequence[int]) -> str:
    terms = [f"i{axis}" if step == 1 else f"{step} * i{axis}" for axis, step in enumerate(steps) if step]
    return " + ".join([*([str(corner)] if corner or not terms else []), *terms])


def nest(shape: Sequence[int], body: str, first: int = 0) -> str:
    heads = (f"for (int i{first + k} = 0; i{first + k} < {size}; ++i{first + k}) " for k, size in enumerate(shape))
    return "".join(heads) + f"{{{{ {body} }}}}"


def mapping(template: str, operands: Sequence[Code], shape: tuple[int, ...]) -> Code:
    """An operation on each entry."""
    place = _index(0, [int(np.prod(shape[axis + 1 :])) for axis in range(len(shape))])
    return Code(nest(shape, f"{{out}}[{place}] = {template};"), operands)


def folding(template: str, operand: Code | None, shape: tuple[int, int]) -> Code:
    """The entries of each row put together by an operation of two."""
    assert operand is not None  # contiguous
    start = operand.text.replace("i1", "0")
    inner = nest(shape[1:], "s = " + template.replace("{0}", "s").replace("{1}", "{0}") + ";", first=1)
    inner = inner.replace("i1 = 0", "i1 = 1", 1)
    return Code(nest(shape[:1], f"real s = {start}; {inner} {{out}}[i0] = s;"), (operand,))


def stores(out: str, entries: np.ndarray, tables: Tables) -> str:
    """Lines that write entries into an array: the same number, and runs of another array, by loops."""
    lines, i = [], 0
    while i < len(entries):
        run, step = _run(entries[i:])
        value = tables.text(entries[i])
        if run >= LOOPED:
            first = entries[i]
            in_array = isinstance(first, Entry) and first.index is not None
            source = f"{first.name}[{_index(first.index or 0, [step])}]" if in_array else value
            lines.append(f"for (int i0 = 0; i0 < {run}; ++i0) {{{{ {out}[{_index(i, [1])}] = {source}; }}}}")
        else:
            run = 1
            lines.append(f"{out}[{i}] = {value};")
        i += run
    return "\n".join(lines)


def _run(entries: np.ndarray) -> tuple[int, int]:
    """How many of the first entries follow each other in one array, and how far apart, or are the same number."""
    first, step = entries[0], 0
    if (places := _places(entries[:2])) is not None and len(places) > 1:
        step = int(places[1] - places[0])
    for count, one in enumerate(entries):
        expected = replace(first, index=first.index + step * count) if step else first
        if one != expected:
            return count, step
    return len(entries), step


def needed(statements: Sequence[Statement], results: frozenset[str]) -> list[Statement]:
    """The statements without those that the results do not need."""
    kept, wanted = [], set(results)
    for statement in reversed(statements):
        if statement.defines in wanted:
            kept.append(statement)
            wanted |= statement.uses
    return kept[::-1]


def declared(statements: Sequence[Statement], results: frozenset[str], end: Sequence[str]) -> str:
    """The code of statements and of what stands at the end, with arrays declared.

    An array takes the place of one of its type, and of its size or more, that is not read any more: compilers keep each
    on the stack.
    """
    last = {name: i for i, statement in enumerate(statements) for name in statement.uses}
    kinds = {statement.defines: statement.array for statement in statements if statement.array}
    places, spare, lines = {}, [], []
    for i, statement in enumerate(statements):
        if (kind := statement.array) is not None:
            fitting = [one for one in spare if kinds[one][0] == kind[0] and kinds[one][1] >= kind[1]]
            place = min(fitting, key=lambda one: kinds[one][1], default=statement.defines)
            if fitting:
                spare.remove(place)
            else:
                lines.append(f"{kind[0]} {place}[{kind[1]}];")
            places[statement.defines] = place
        lines.append(statement.text)
        ended = (name for name in sorted(statement.uses - results) if last[name] == i)
        spare += [places[name] for name in ended if name in kinds]
    return re.sub(r"\ba\d+\b", lambda found: places.get(found[0], found[0]), "\n".join([*lines, *end]))
