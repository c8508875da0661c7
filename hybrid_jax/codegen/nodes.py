"""Generated code as values: expressions, statements and functions, which a printer writes in a language.

An expression is a number (a float, a bool, or an int for a count), a `Reference` or an `Operation`, named as in JAX.
The counters of loops are numbered from the outermost: i0, i1, …
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any


@dataclass(frozen=True)
class Node:
    """A piece of code, a frozen dataclass; pieces in it are its fields, or in tuples there."""


@dataclass(frozen=True)
class Reference(Node):
    """What has the name of a variable or an array."""

    name: str


@dataclass(frozen=True)
class Entry(Reference):
    """A variable, or an entry of an array at a place that is known.

    Attributes:
        name: of the variable or array.
        index: the place; None for a variable.
        logical: whether it is an int, 0 or 1; else it is a real.
    """

    index: int | None = None
    logical: bool = False


@dataclass(frozen=True)
class Element(Reference):
    """The entry of an array at corner + Σ steps[k] ik, in loops with counters ik."""

    corner: int = 0
    steps: tuple[int, ...] = ()


@dataclass(frozen=True)
class Address(Reference):
    """Where entries of an array begin, at a place as of `Element`."""

    corner: int = 0
    steps: tuple[int, ...] = ()


@dataclass(frozen=True)
class Operation(Node):
    """An operation of JAX on scalars."""

    name: str
    operands: tuple["Expression", ...]


Expression = float | bool | int | Reference | Operation


@dataclass(frozen=True)
class Variable(Node):
    """A new variable with its value, which changes later only if it is not `constant`."""

    name: str
    value: Expression
    logical: bool = False
    constant: bool = True


@dataclass(frozen=True)
class Array(Node):
    """A new array, which holds nothing yet."""

    name: str
    size: int
    logical: bool = False


@dataclass(frozen=True)
class Assign(Node):
    """An entry gets a value."""

    target: Entry | Element
    value: Expression


@dataclass(frozen=True)
class Loop(Node):
    """Statements for each value of the counter from `start` to `stop` − 1."""

    counter: int
    stop: int
    body: tuple["Statement", ...]
    start: int = 0


@dataclass(frozen=True)
class Call(Node):
    """A function is called, which writes what it finds into some of its arguments."""

    function: str
    arguments: tuple[Expression, ...]


Statement = Variable | Array | Assign | Loop | Call


@dataclass(frozen=True)
class Parameter(Node):
    """A number that a function takes, or the entries of an array, which it may change if `written`."""

    name: str
    logical: bool = False
    array: bool = False
    written: bool = False


@dataclass(frozen=True)
class Function(Node):
    """A function of the file, which returns nothing."""

    name: str
    parameters: tuple[Parameter, ...]
    body: tuple[Statement, ...]


@dataclass(frozen=True)
class Step:
    """Statements that make one variable, or one array, which is then still to be declared."""

    makes: str
    code: tuple[Statement, ...]
    array: Array | None = None

    @cached_property
    def uses(self) -> frozenset[str]:
        """The names of what it is made from."""
        return names(self.code) - {self.makes}


def walk(node: Any) -> Iterator[Any]:
    """A node, or a tuple of nodes, and all that is in it."""
    yield node
    for inside in node if isinstance(node, tuple) else vars(node).values() if isinstance(node, Node) else ():
        yield from walk(inside)


def names(node: Any) -> frozenset[str]:
    """The names that references in a node have."""
    return frozenset(one.name for one in walk(node) if isinstance(one, Reference))


def renamed(node: Any, others: Mapping[str, str]) -> Any:
    """A node in which some variables and arrays have other names."""
    if isinstance(node, tuple):
        return tuple(renamed(one, others) for one in node)
    if not isinstance(node, Node):
        return node
    if isinstance(node, Reference):
        return replace(node, name=others.get(node.name, node.name))
    return replace(node, **{key: renamed(one, others) for key, one in vars(node).items()})


def nested(shape: Sequence[int], *body: Statement) -> Statement:
    """Statements in a loop over each axis, of which there is at least one."""
    for counter, size in reversed(list(enumerate(shape))):
        body = (Loop(counter, size, body),)
    return body[0]


def arranged(steps: Sequence[Step], results: frozenset[str], end: Sequence[Statement]) -> tuple[Statement, ...]:
    """The body of a function: the steps that its end needs, which reads `results`, with arrays declared, and the end.

    An array takes the place of one of its type, and of its size or more, that is not read any more: compilers keep each
    on the stack.
    """
    steps = _needed(steps, results)
    last = {name: i for i, step in enumerate(steps) for name in step.uses}
    arrays = {step.makes: step.array for step in steps if step.array}
    places: dict[str, str] = {}
    spare: list[Array] = []
    body: list[Statement] = []
    for i, step in enumerate(steps):
        if (array := step.array) is not None:
            fitting = [one for one in spare if one.logical == array.logical and one.size >= array.size]
            place = min(fitting, key=lambda one: one.size, default=array)
            if fitting:
                spare.remove(place)
            else:
                body.append(array)
            places[step.makes] = place.name
        body += renamed(step.code, places)
        ended = (name for name in sorted(step.uses - results) if last[name] == i)
        spare += [arrays[places[name]] for name in ended if name in arrays]
    return *body, *renamed(tuple(end), places)


def _needed(steps: Sequence[Step], results: frozenset[str]) -> list[Step]:
    """The steps without those that the results do not need."""
    kept, wanted = [], set(results)
    for step in reversed(steps):
        if step.makes in wanted:
            kept.append(step)
            wanted |= step.uses
    return kept[::-1]
