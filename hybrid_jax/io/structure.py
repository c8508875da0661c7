"""The structure of a field as JSON: classes and functions by name, static values, and the path of each array.

A file cannot choose code to run: a class must be an Equinox module in a module that is already imported.
"""

import builtins
import dataclasses
import inspect
import math
import sys
from collections.abc import Callable, Iterable, Mapping
from dataclasses import is_dataclass
from functools import partial
from types import ModuleType
from typing import Any, TypeVar, overload

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import AbstractArray, jaxtyped

from hybrid_jax import dynamics, networks  # noqa: F401  a file may name their classes
from hybrid_jax.checks import short_repr
from hybrid_jax.io.files import Arrays, array_type, from_numpy
from hybrid_jax.networks import views  # noqa: F401

_ACTIVATIONS = """celu elu gelu glu hard_sigmoid hard_silu hard_swish hard_tanh identity leaky_relu log1mexp log_sigmoid
    log_softmax mish relu relu6 selu sigmoid silu soft_sign softmax softplus sparse_plus sparse_sigmoid squareplus
    standardize swish tanh"""
_ELEMENTWISE = """abs add arccos arccosh arcsin arcsinh arctan arctan2 arctanh cbrt ceil clip conj cos cosh deg2rad
    divide exp exp2 expm1 floor hypot imag log log10 log1p log2 logaddexp maximum minimum mod multiply negative positive
    power rad2deg real reciprocal round sign sin sinc sinh sqrt square subtract tan tanh where"""
_TYPES = """bool_ int8 int16 int32 int64 uint8 uint16 uint32 uint64 float16 bfloat16 float32 float64 complex64
    complex128"""
_KNOWN = {jax.nn: _ACTIVATIONS, jnp: f"{_ELEMENTWISE} {_TYPES}", np: _TYPES, builtins: "bool int float complex"}
# The functions and types that a file may name.
_ALLOWED: dict[str, Any] = {
    f"{module.__name__}.{name}": vars(module)[name]
    for module, names in _KNOWN.items()
    for name in names.split()
    if name in vars(module)
}
_ALLOWED["equinox.identity"] = inspect.signature(eqx.nn.MLP).parameters["final_activation"].default
_PORTABLE: dict[str, Any] = {}  # "@name" → class or function

# Keys of JSON objects: names of things, and content.
_NAMES = {"class", "named", "unknown", "array", "static", "key", "dtype"}
_CONTENT = {"fields", "items", "tuple", "list", "float", "complex"}
Item = TypeVar("Item", bound=Callable)


@overload
def portable(item: Item, *, name: str | None = None) -> Item: ...
@overload
def portable(item: None = None, *, name: str | None = None) -> Callable[[Item], Item]: ...
def portable(item: Any = None, *, name: str | None = None) -> Any:
    """Decorate a class or function so that saved models refer to it by `name` instead of by its module.

    You should use this for an Equinox class that you may move to another module, and for functions in a field or other
    dataclasses, which could otherwise only be loaded with `like`.

    Args:
        item: the class or function. Without it, as in `@portable(name="mine")`, the result is the decorator.
        name: the name in files; by default its own. It should be unique: ValueError if another one has it.
    """
    if item is None:
        return partial(portable, name=name)
    name = f"@{item.__name__ if name is None else name}"
    taken = _PORTABLE.get(name)
    if taken is not None and _address(taken) != _address(item):
        raise ValueError(f"name {name[1:]!r} is taken by {_address(taken)}; use portable(name=...)")
    _PORTABLE[name] = item
    return item


def _address(item: Any) -> str:
    return f"{item.__module__}:{item.__qualname__}"


class Structure:
    """The structure of a field; ValueError, with its path, if a part cannot be saved."""

    def __init__(self, field: eqx.Module):
        if not isinstance(field, eqx.Module):
            raise ValueError(f"field must be an Equinox module, got {short_repr(field)}")
        self.static_arrays: dict[str, Any] = {}  # by path; the other arrays are leaves of the field
        self.problem: str | None = None  # why `decode` cannot rebuild the field
        self.of_script: str | None = None  # a class that other programs cannot import
        try:
            self.tree = self._encode(field, "field", static=False)
        except RecursionError as error:
            raise ValueError("field is nested too deeply to be saved, or contains itself") from error

    def _encode(self, value: Any, path: str, static: bool) -> Any:
        kind = type(value)
        if value is None or kind in (bool, int, str) or (kind is float and math.isfinite(value)):
            return value
        if kind in (float, complex):
            return {kind.__name__: repr(value)}
        if kind in (list, tuple):
            return {kind.__name__: [self._encode(item, f"{path}/{i}", static) for i, item in enumerate(value)]}
        if kind is dict and all(type(key) in (str, int) for key in value):
            return {"items": [[key, self._encode(item, f"{path}/{key}", static)] for key, item in value.items()]}
        if eqx.is_array(value):
            if static:
                self.static_arrays[path := f"static/{path}"] = value
            return {"static" if static else "array": path, **array_type(value)}
        if isinstance(value, np.dtype):
            return {"dtype": value.name}
        if (name := _name_of(value)) is not None:
            return {"named": name}
        if is_dataclass(value) and not isinstance(value, type):
            return self._encode_fields(value, path, static)
        return self._encode_unknown(value, path, static)

    def _encode_fields(self, value: Any, path: str, static: bool) -> Any:
        name = _name_of(type(value)) or _address(type(value))
        if name.startswith("__main__:") and hasattr(sys.modules["__main__"], "__file__"):  # not a notebook's
            self.of_script = type(value).__name__
        try:
            if find_class(name) is not type(value):
                self.problem = self.problem or f"{path} is of a class that {name} no longer refers to"
        except ValueError as error:
            self.problem = self.problem or f"{path}: {str(error).partition(';')[0]}"  # without the remedy
        static |= not isinstance(value, eqx.Module)
        parts = {
            f.name: self._encode(getattr(value, f.name), f"{path}/{f.name}", static or f.metadata.get("static", False))
            for f in dataclasses.fields(value)
        }
        return {"class": name, "fields": parts}

    def _encode_unknown(self, value: Any, path: str, static: bool) -> Any:
        name = _address(type(value))
        if callable(value):
            name = f"the callable {getattr(value, '__qualname__', name)}, which is not `hybrid_jax.portable`"
        elif not static and jax.tree_util.all_leaves([value]):
            what = f"{path} is of type {name}, which cannot be saved"
            raise ValueError(f"{what}; expected an array, number, text, function, container or module")
        self.problem = self.problem or f"{path} is {name}"
        return {"unknown": f"{path} is {name}"}


def decode(value: Any, arrays: Arrays) -> Any:
    """Make the object that a structure describes; ValueError for unknown classes, or Python's errors if malformed."""
    match value:
        case None | bool() | int() | float() | str():
            return value
        case {"class": str() as name, "fields": dict() as parts}:
            return _rebuild(name, {key: decode(part, arrays) for key, part in parts.items()})
        case {"array": str() as path, **kind}:
            return jnp.asarray(from_numpy(arrays[path], kind))
        case {"static": str() as path, **kind}:
            return from_numpy(arrays[path], kind)[()]
        case {"items": list() as items}:
            return {key: decode(item, arrays) for key, item in items}
        case {"tuple": list() as items}:
            return tuple(decode(item, arrays) for item in items)
        case {"list": list() as items}:
            return [decode(item, arrays) for item in items]
        case {"float": str() as text}:
            return float(text)
        case {"complex": str() as text}:
            return complex(text)
        case {"dtype": str() as name}:
            return np.dtype(name)
        case {"named": str() as name}:
            if name not in (known := _ALLOWED | _PORTABLE):
                raise ValueError(f"function {name} is not known here; import the module that defines it, or pass like=")
            return known[name]
        case {"unknown": str() as reason}:
            raise ValueError(f"{reason}; pass like=")
    raise ValueError("an entry of its structure is malformed")


def static_values(tree: Any) -> dict[str, Any]:
    """Return the numbers, strings and None in a structure, by path."""
    found = {}
    for keys, leaf in jax.tree_util.tree_leaves_with_path(tree, is_leaf=lambda node: node is None):
        path = jax.tree_util.keystr(keys, simple=True, separator="/").split("/")
        if not _NAMES & set(path):
            found["/".join(["field", *(part for part in path if part not in _CONTENT)])] = leaf
    return found


def find_class(name: str) -> type:
    """Find the class "module:qualname" of an imported module, or a portable one "@name"; ValueError for other types."""
    module, _, qualname = name.partition(":")
    found: Any = _PORTABLE.get(name, sys.modules.get(module))
    if found is None:
        needed = f"the module that makes {name[1:]} portable" if name.startswith("@") else module
        raise ValueError(f"class {name} is not known here; import {needed} first, or pass like=")
    for part in qualname.split(".") if qualname else ():  # not getattr: a class's own __getattr__ could run code
        found = vars(found).get(part) if isinstance(found, type | ModuleType) else None
    trusted = name in _PORTABLE or module.startswith("hybrid_jax.")  # such as Vehicle, a frozen dataclass
    if not isinstance(found, type) or not (issubclass(found, eqx.Module) or (trusted and is_dataclass(found))):
        raise ValueError(f"{name} is not an Equinox module at the top level of a Python module; pass like=")
    if qualname and _address(found) != name:
        raise ValueError(f"{name} is another name of {_address(found)}; pass like=")
    return found


def _rebuild(name: str, parts: dict[str, Any]) -> Any:
    """Make an object with these fields, without its `__init__` but with the checks of this library's own classes."""
    cls: Any = find_class(name)
    made, known = object.__new__(cls), dataclasses.fields(cls)
    values = {f.name: f.default for f in known if f.default is not dataclasses.MISSING} | parts
    if values.keys() != {f.name for f in known}:
        wanted, given = ", ".join(f.name for f in known), ", ".join(parts) or "none"
        raise ValueError(f"class {name} has fields {wanted}, but the file has {given}")
    for key, value in values.items():
        object.__setattr__(made, key, value)
    if cls.__module__.startswith("hybrid_jax."):
        _require_shapes(name, known, values)
    for base in reversed(cls.__mro__):  # for example, a damaged file must not give a vehicle of negative mass
        for check in ("__post_init__", "__check_init__"):
            if base.__module__.startswith("hybrid_jax.") and check in vars(base):
                vars(base)[check](made)
    return made


def _require_shapes(name: str, known: Iterable[dataclasses.Field], values: Mapping[str, Any]) -> None:
    """Require arrays as the class declares them. All may have extra leading axes, for example for stacked models."""
    stated = {f.name: f.type for f in known if isinstance(f.type, type) and issubclass(f.type, AbstractArray)}
    with jaxtyped("context"):
        for key, kind in stated.items():
            if set("*+") & {*kind.dim_str}:  # any shape, or sizes that another class states
                continue
            value = values[key]
            if not isinstance(value, kind.dtype[kind.array_type, f"*others {kind.dim_str}"]):
                found = f"{value.dtype}{list(value.shape)}" if eqx.is_array(value) else short_repr(value)
                sizes = ", ".join(kind.dim_str.split())
                raise ValueError(f"{name}: {key} must be {kind.dtype.__name__}[{sizes}] like the others, got {found}")


def _name_of(value: Any) -> str | None:
    return next((name for name, item in (_PORTABLE | _ALLOWED).items() if item is value), None)
