"""Compiled programs that are kept on disk, so that the next process neither traces nor compiles them.

JAX's own cache keeps what XLA compiled, but finds it by the traced program, and tracing takes most of the time. Here a
program is found by what it is made of: the function, the structure and shapes of its arguments, the source of our
packages, the versions of the libraries, the devices and the options. After a change of the source it is traced again,
and compiled again if it is another program.

A program is kept only if these tell all about it. One that calls a class or function of another package is not, since
its source may change unseen; nor is a closure. It is traced as ever, and JAX's cache still serves it.
"""

import contextlib
import functools
import hashlib
import inspect
import io
import os
import pickle
import sys
import threading
import types
from collections.abc import Callable, Hashable, Mapping, Sequence
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple, ParamSpec, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.experimental import serialize_executable

from hybrid_jax import checks, native, runtime

OWN = ("hybrid_jax", "experiments", "benchmarks")  # known by their source
LIBRARIES = ("jax", "jaxlib", "numpy", "equinox", "diffrax", "optimistix", "lineax", "optax", "mujoco", "mujoco-mjx")
STANDARD = ("builtins", "collections", "copyreg", "functools", "ml_dtypes", "operator", "types")
KNOWN = frozenset((*OWN, *LIBRARIES, *STANDARD))  # packages whose code the key describes
IN_MEMORY = 64  # programs of one function
HIT = "/jax/compilation_cache/cache_hits"
UNDESCRIBED = pickle.PicklingError, AttributeError, TypeError, ValueError, RecursionError  # all that pickle raises


P = ParamSpec("P")
R = TypeVar("R")


class _Compiler(threading.local):
    """How often JAX's cache had a program that this thread asked for."""

    hits = 0


_compiler = _Compiler()


def _count(event: str, **_) -> None:
    _compiler.hits += event == HIT


jax.monitoring.register_event_listener(_count)


def kept_jit(function: Callable[P, R], **options: Any) -> Callable[P, R]:
    """`equinox.filter_jit` whose programs are kept in the folder of `runtime.configure`, if that was called.

    It is `filter_jit` itself under another transformation, in a run of several processes, and for a program that cannot
    be kept. A file that is damaged, or of other code, versions, options or devices, is not read but made anew.

    Args:
        options: of `jax.jit`, such as `compiler_options`.
    """
    return functools.update_wrapper(_Kept(function, options), function)  # pyright: ignore[reportReturnType]


def prepare(kept: Callable[P, Any], *args: P.args, **kwargs: P.kwargs) -> None:
    """Compile, or read, the program of what `kept_jit` returned for later calls with arguments of these shapes."""
    if isinstance(kept, _Kept):
        kept.bound(args, kwargs)


class _Kept:
    """See `kept_jit`."""

    def __init__(self, function: Callable, options: dict[str, Any]):
        self._name = function.__name__.strip("_")
        self._function, self._options = function, options
        self._jit = eqx.filter_jit(function, **options)
        self._programs: dict[Hashable, Callable | None] = {}  # by what a call has in common with another one

    def __call__(self, *args, **kwargs):
        return self.bound(args, kwargs)()

    def bound(self, args: tuple, kwargs: Mapping[str, Any]) -> Callable[[], Any]:
        """The call with these arguments. Its program is compiled or read now; one that cannot be kept, in the call."""
        plain = functools.partial(self._jit, *args, **kwargs)
        leaves, structure = jax.tree.flatten((args, kwargs))
        if runtime.kept_programs() is None or jax.process_count() > 1 or any(map(checks.is_traced, leaves)):
            return plain
        fixed = tuple(None if eqx.is_array(leaf) else (type(leaf), leaf) for leaf in leaves)
        arrays = [leaf for leaf in leaves if eqx.is_array(leaf)]
        key = structure, fixed, tuple(map(_kind, arrays)), _context()
        if key not in self._programs:
            if len(self._programs) == IN_MEMORY:
                self._programs.pop(next(iter(self._programs)))
            self._programs[key] = self._program(leaves, structure)
        program = self._programs[key]
        return plain if program is None else functools.partial(program, arrays)

    def _program(self, leaves: list, structure) -> Callable | None:
        """The program from its file, or compiled now; None if it cannot be kept."""
        try:
            path = self._path(leaves, structure)
        except UNDESCRIBED:
            return None
        return _loaded(_read(path), path) or self._compile(leaves, structure, path)

    def _path(self, leaves: list, structure) -> Path:
        shapes = jax.tree.unflatten(structure, [_kind(leaf) if eqx.is_array(leaf) else leaf for leaf in leaves])
        described, packages = _described((self._function, shapes, self._options))
        call = hashlib.sha256(described + repr((_context(), _environment())).encode()).hexdigest()
        source = hashlib.sha256("".join(map(source_digest, sorted(packages))).encode()).hexdigest()
        folder = runtime.kept_programs()
        assert folder is not None  # asked by the caller
        return folder / f"{self._name}_{call}-{source}{runtime.EXECUTABLE}"

    def _compile(self, leaves: list, structure, path: Path) -> Callable:
        """The program for these arguments; kept in a file if its result can be described."""
        arrays = [leaf for leaf in leaves if eqx.is_array(leaf)]
        fixed = [None if eqx.is_array(leaf) else leaf for leaf in leaves]
        results = []

        def flat(arrays):
            left = iter(arrays)
            args, kwargs = jax.tree.unflatten(structure, [next(left) if leaf is None else leaf for leaf in fixed])
            found = jax.tree.flatten(self._function(*args, **kwargs))
            results[:] = [found]
            return [leaf for leaf in found[0] if eqx.is_array(leaf)]

        flat.__name__ = path.name.partition("-")[0]  # for JAX's cache, too
        lowered = jax.jit(flat, **self._options).lower(arrays)
        text = hashlib.sha256(lowered.as_text().encode()).digest()
        (found, shape), *_ = results
        rest = [None if eqx.is_array(leaf) else (leaf,) for leaf in found]
        skeleton = jax.tree.unflatten(shape, range(len(rest)))
        if program := _taken_over(path, text, skeleton, rest):
            return program
        _compiler.hits = 0  # not of small programs that ran while this one was traced
        compiled = lowered.compile()
        if _compiler.hits:  # jaxlib loses the kernels of a program from JAX's cache when it is serialised again
            for entry in path.parent.glob(f"jit_{flat.__name__}-*"):
                entry.unlink(missing_ok=True)  # so that the next process compiles and keeps it
        else:
            _keep(path, compiled, text, len(arrays), skeleton, rest)
        return functools.partial(_call, compiled, skeleton, rest)


class _File(NamedTuple):
    """What is kept of a program."""

    text: bytes  # the digest of what XLA compiled
    executable: bytes
    devices: tuple[str, list[int]]
    inputs: int
    skeleton: Any
    rest: Sequence


def _keep(path: Path, compiled, text: bytes, inputs: int, skeleton, rest: Sequence) -> None:
    """Write the program to its file, unless JAX or pickle cannot serialise it, or the disk is full."""
    try:
        executable = serialize_executable.serialize(compiled)[0]
        _write(path, _File(text, executable, _devices(compiled), inputs, skeleton, rest))
    except (pickle.PicklingError, AttributeError, TypeError, ValueError, NotImplementedError, OSError):
        pass  # it serves this process


def _taken_over(path: Path, text: bytes, skeleton, rest: Sequence) -> Callable | None:
    """The same program from a file that another source left; it is kept for this source, too."""
    for other in path.parent.glob(f"{path.name.partition('-')[0]}-*{runtime.EXECUTABLE}"):
        file = _read(other)
        if file is not None and file.text == text:
            file = file._replace(skeleton=skeleton, rest=rest)
            if program := _loaded(file, other):
                with contextlib.suppress(OSError):  # the disk is full
                    _write(path, file)
                return program
    return None


def _write(path: Path, file: _File) -> None:
    content = pickle.dumps(tuple(file))
    temporary = path.with_name(f".{path.name}.{os.getpid()}.part")
    temporary.write_bytes(hashlib.sha256(content).digest() + content)
    os.replace(temporary, path)


@functools.cache
def source_digest(package: str) -> str:
    """The digest of all Python files of a package."""
    spec = find_spec(package)
    digest = hashlib.sha256()
    for root in sorted(spec.submodule_search_locations or ()) if spec else ():
        for path in sorted(Path(root).rglob("*.py")):
            digest.update(f"{path.relative_to(root)}\n".encode() + path.read_bytes())
    return digest.hexdigest()


def _read(path: Path) -> _File | None:
    """What is in a file; None if there is none, or it is damaged."""
    try:
        data = path.read_bytes()
        digest, content = data[:32], data[32:]
        return _File(*pickle.loads(content)) if hashlib.sha256(content).digest() == digest else None
    except Exception:  # whatever a file of another making raises: the program is compiled anew
        return None


def _loaded(file: _File | None, path: Path) -> Callable | None:
    """The program in what was read from a path; None if it cannot be loaded."""
    if file is None:
        return None
    try:
        runtime.load_lapack()  # JAX does that when it lowers a first call, which it may not do here
        native.register()
        platform, ids = file.devices
        by_id = {device.id: device for device in jax.devices(platform)}
        before = jax.tree.structure((([0] * file.inputs,), {}))
        after = jax.tree.structure([0] * sum(leaf is None for leaf in file.rest))
        chosen = [by_id[i] for i in ids]
        compiled = serialize_executable.deserialize_and_load(file.executable, before, after, platform, chosen)
    except Exception:  # as in `_read`
        return None
    path.touch()  # those that nobody uses are deleted, see runtime
    return functools.partial(_call, compiled, file.skeleton, file.rest)


def _call(compiled, skeleton, rest: Sequence, arrays: list) -> Any:
    found = iter(compiled(arrays))
    leaves = [next(found) if leaf is None else leaf[0] for leaf in rest]
    return jax.tree.unflatten(jax.tree.structure(skeleton), leaves)


def _devices(compiled) -> tuple[str, list[int]]:
    """Platform and ids of the devices that a compiled program runs on, in its order."""
    shardings = jax.tree.leaves((compiled.input_shardings, compiled.output_shardings))
    meshes = (sharding.mesh for sharding in shardings if isinstance(sharding, jax.sharding.NamedSharding))
    devices = next((list(mesh.devices.flat) for mesh in meshes if mesh.devices is not None), [*shardings[0].device_set])
    return devices[0].platform, [device.id for device in devices]


def _kind(array) -> tuple:
    """What a program is compiled for: shape, type, and where the array lies if that is fixed."""
    if not isinstance(array, jax.Array):
        return array.shape, str(jnp.result_type(array)), False, None
    placed = repr(array.sharding) if array.committed else None
    return array.shape, str(array.dtype), array.aval.weak_type, placed


def _context() -> tuple:
    """JAX's settings that change a program and may change within a process."""
    names = ("default_matmul_precision", "default_device", "default_prng_impl", "threefry_partitionable")
    return str(jnp.result_type(float)), *(str(getattr(jax.config, f"jax_{name}")) for name in names)


@functools.cache
def _environment() -> tuple:
    return tuple((name, version(name)) for name in LIBRARIES), runtime.machine(), native.identity()


@functools.cache
def _is_ours_or_a_library(package: str) -> bool:
    """False for another's package of the name of one of ours, which may call what its own source does not show."""
    if package not in OWN:
        return True
    spec = find_spec(package)
    folders = [] if spec is None else list(spec.submodule_search_locations or ())
    return folders == [str(Path(__file__).parents[1] / package)]


class _Description(pickle.Pickler):
    """Pickles by name only what belongs to KNOWN packages; notes which of OWN."""

    def __init__(self, file):
        super().__init__(file, protocol=5)
        self.fast = True  # no memo: the same bytes for an object met twice as for two that are equal
        self.packages = {"hybrid_jax"}

    def persistent_id(self, obj: Any):
        return ("device", obj.platform, obj.id) if isinstance(obj, jax.Device) else None

    def reducer_override(self, obj: Any):
        name, module = getattr(obj, "__qualname__", None), getattr(obj, "__module__", None)
        if not callable(obj) or not isinstance(name, str) or not isinstance(module, str):
            return NotImplemented
        package, found = module.partition(".")[0], _by_name(module, name)
        if package in KNOWN and _is_ours_or_a_library(package) and (found is obj or inspect.unwrap(found) is obj):
            self.packages.update({package} & set(OWN))
            # Pickle names classes and plain functions itself, but not what a decorator returned or was given.
            plain = found is obj and isinstance(obj, type | types.FunctionType)
            return NotImplemented if plain else (_by_name, (module, name))
        if isinstance(obj, type) or hasattr(obj, "__code__"):
            raise pickle.PicklingError(f"{module}.{name} is not described by its name")
        return NotImplemented


def _by_name(module: str, name: str) -> Any:
    try:
        return functools.reduce(getattr, name.split("."), sys.modules[module])
    except (AttributeError, KeyError):
        return None


def _described(value: Any) -> tuple[bytes, set[str]]:
    """The value as bytes that are the same in every process, and which packages of OWN it is made with.

    Raises:
        PicklingError or another of UNDESCRIBED: it holds what its bytes would not describe.
    """
    file = io.BytesIO()
    pickler = _Description(file)
    pickler.dump(value)
    return file.getvalue(), pickler.packages
