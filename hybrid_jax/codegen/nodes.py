"""Generated code as values (expressions, statements and functions) that a printer writes in a language.

An expression is a number (a float, a bool, or an int for a count), a `Reference` or an `Operation`, named as in JAX.
Loop counters are numbered from the outermost: i0, i1, …
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any


@dataclass(frozen=True)
class Node:
    """A piece of code, a frozen dataclass; its children are fields, or in tuples there."""


@dataclass(frozen=True)
class Reference(Node):
    """A node with the name of a variable or an array."""

    name: str


@dataclass(frozen=True)
class Entry(Reference):
    """A variable, or an entry of an array at a known index.

    Attributes:
        name: name of the variable or array.
        index: index in the array; None for a variable.
        logical: whether it is an int (0 or 1) instead of a real.
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
    """The start of entries of an array, at an index like `Element`'s."""

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
    """Define a variable, which changes later only if it is not `constant`."""

    name: str
    value: Expression
    logical: bool = False
    constant: bool = True


@dataclass(frozen=True)
class Array(Node):
    """Declare an uninitialised array."""

    name: str
    size: int
    logical: bool = False


@dataclass(frozen=True)
class Assign(Node):
    target: Entry | Element
    value: Expression


@dataclass(frozen=True)
class Loop(Node):
    """Repeat statements for each value of the counter from `start` to `stop` − 1."""

    counter: int
    stop: int
    body: tuple["Statement", ...]
    start: int = 0


@dataclass(frozen=True)
class Call(Node):
    """Call a function, which writes its results into some of its arguments."""

    function: str
    arguments: tuple[Expression, ...]


Statement = Variable | Array | Assign | Loop | Call


@dataclass(frozen=True)
class Parameter(Node):
    """A number argument of a function, or an array, which it may change if `written`."""

    name: str
    logical: bool = False
    array: bool = False
    written: bool = False


@dataclass(frozen=True)
class Function(Node):
    """A function of the file without return value."""

    name: str
    parameters: tuple[Parameter, ...]
    body: tuple[Statement, ...]


@dataclass(frozen=True)
class Step:
    """Statements that make one variable, or one array, which is not declared yet."""

    makes: str
    code: tuple[Statement, ...]
    array: Array | None = None

    @cached_property
    def uses(self) -> frozenset[str]:
        """Names that the statements read."""
        return names(self.code) - {self.makes}


def walk(node: Any) -> Iterator[Any]:
    """Iterate over a node, or a tuple of nodes, and all its descendants."""
    yield node
    for inside in node if isinstance(node, tuple) else vars(node).values() if isinstance(node, Node) else ():
        yield from walk(inside)


def names(node: Any) -> frozenset[str]:
    """Names of the references in a node."""
    return frozenset(one.name for one in walk(node) if isinstance(one, Reference))


def renamed(node: Any, others: Mapping[str, str]) -> Any:
    """Rename some variables and arrays in a node."""
    if isinstance(node, tuple):
        return tuple(renamed(one, others) for one in node)
    if not isinstance(node, Node):
        return node
    if isinstance(node, Reference):
        return replace(node, name=others.get(node.name, node.name))
    return replace(node, **{key: renamed(one, others) for key, one in vars(node).items()})


def nested(shape: Sequence[int], *body: Statement) -> Statement:
    """Nest statements in a loop over each axis, of which there must be at least one."""
    for counter, size in reversed(list(enumerate(shape))):
        body = (Loop(counter, size, body),)
    return body[0]


def arranged(steps: Sequence[Step], results: frozenset[str], end: Sequence[Statement]) -> tuple[Statement, ...]:
    """Assemble a function's body: the needed steps and the end. Arrays that are no longer read are reused."""
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
    """Remove steps that the results do not need."""
    kept, wanted = [], set(results)
    for step in reversed(steps):
        if step.makes in wanted:
            kept.append(step)
            wanted |= step.uses
    return kept[::-1]
