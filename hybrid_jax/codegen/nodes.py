"""Generated code as values (expressions and statements) that a printer writes in a language.

An expression is a number (a float, a bool, or an int for a count), an `Entry` or an `Operation`, named as in JAX.
Loop counters are numbered from the outermost: i0, i1, …
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, is_dataclass, replace
from functools import cached_property
from typing import Any


@dataclass(frozen=True)
class Entry:
    """A variable, or the entry of an array at index + Σ steps[k] ik in loops with counters ik. Booleans are 0 or 1."""

    name: str
    index: int | None = None
    steps: tuple[int, ...] = ()


class Address(Entry):
    """The address of an entry."""


@dataclass(frozen=True)
class Operation:
    """An operation of JAX on scalars."""

    name: str
    operands: tuple["Expression", ...]


Expression = float | bool | int | Entry | Operation


@dataclass(frozen=True)
class Variable:
    """Define a constant."""

    name: str
    value: Expression


@dataclass(frozen=True)
class Array:
    """Declare an uninitialised array."""

    name: str
    size: int


@dataclass(frozen=True)
class Assign:
    target: Entry
    value: Expression


@dataclass(frozen=True)
class Loop:
    """Repeat statements for each value of the counter from `start` to `stop` − 1."""

    counter: str
    stop: int
    body: tuple["Statement", ...]
    start: int = 0


@dataclass(frozen=True)
class Call:
    """Call a function, which writes its results to some of its arguments."""

    function: str
    arguments: tuple[Expression, ...]


Statement = Variable | Array | Assign | Loop | Call


@dataclass(frozen=True)
class Function:
    name: str
    inputs: tuple[Array, ...]
    outputs: tuple[Array, ...]
    body: tuple[Statement, ...]


@dataclass(frozen=True)
class Step:
    """Statements that set one variable, or one array, which they do not declare."""

    makes: str
    code: tuple[Statement, ...]
    array: Array | None = None

    @cached_property
    def uses(self) -> frozenset[str]:
        return names(self.code) - {self.makes}


def walk(node: Any) -> Iterator[Any]:
    """Iterate over a node, or a tuple of nodes, and all its descendants."""
    yield node
    for inside in node if isinstance(node, tuple) else vars(node).values() if is_dataclass(node) else ():
        yield from walk(inside)


def names(node: Any) -> frozenset[str]:
    return frozenset(one.name for one in walk(node) if isinstance(one, Entry))


def renamed(node: Any, others: Mapping[str, str]) -> Any:
    """Rename some variables and arrays in a node."""
    if isinstance(node, tuple):
        return tuple(renamed(one, others) for one in node)
    if isinstance(node, Entry):
        return replace(node, name=others.get(node.name, node.name))
    if is_dataclass(node):
        return replace(node, **{key: renamed(one, others) for key, one in vars(node).items()})  # type: ignore
    return node


def nested(shape: Sequence[int], *body: Statement) -> Statement:
    """Nest statements in a loop over each axis, of which there must be at least one."""
    for axis, size in reversed(list(enumerate(shape))):
        body = (Loop(f"i{axis}", size, body),)
    return body[0]


def arranged(steps: Sequence[Step], results: frozenset[str], end: Sequence[Statement]) -> tuple[Statement, ...]:
    """Assemble a function's body from the steps that results need, and the end. Arrays no longer read are reused."""
    kept, last = [], dict.fromkeys(results, len(steps))  # name → the step that uses it last
    for i, step in reversed(list(enumerate(steps))):
        if step.makes in last:
            kept.append((i, step))
            last |= {name: i for name in step.uses if name not in last}
    places: dict[str, Array] = {}
    spare, body = list[Array](), list[Statement]()
    for i, step in reversed(kept):
        if (array := step.array) is not None:
            fitting = [one for one in spare if one.size >= array.size]
            place = places[step.makes] = min(fitting, key=lambda one: one.size, default=array)
            if fitting:
                spare.remove(place)
            else:
                body.append(array)
        body += renamed(step.code, {name: one.name for name, one in places.items()})
        spare += [places[name] for name in sorted(step.uses) if last[name] == i and name in places]
    return *body, *renamed(tuple(end), {name: one.name for name, one in places.items()})
