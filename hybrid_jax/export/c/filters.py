"""The steps of filters as C99, with their state as an array of `ravel_pytree`."""

import re
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree

from hybrid_jax.dynamics.base import in_double
from hybrid_jax.export.c.files import CFile
from hybrid_jax.export.program import Size, sizes_of
from hybrid_jax.runtime import entry

Shapes = Mapping[str, tuple[int, ...]]
Places = dict[str, tuple[int, int]]  # where each part of the state begins, and its size
UPDATE = """\
The state after a sample x, NaN where nothing was measured. u is the mean input since the last update, which should be
   {} ago."""


@entry
def export_adaptation_c(
    folder: str | Path,
    adaptation: Any,
    *,
    name: str = "adaptation",
    double: bool = False,
    state_size: Size = None,
    input_size: Size = None,
) -> tuple[Path, Path]:
    """Write the filter of an `OnlineAdaptation` as C99: NAME.h and NAME.c with NAME_begin and NAME_update.

    The functions are equivalent to the methods with these names. Errors are raised as by `export_c`.

    Args:
        folder: where the files are written; it is created if it does not exist.
        adaptation: the filter.
        name: name of the files and prefix of the definitions, see `export_c`.
        double: compute in double instead of single precision.
        state_size: d; by default from the filter's field.
        input_size: m; by default from the filter's field.

    Returns:
        The paths of the header and of the source.
    """
    file, (d, m) = CFile(name, double), sizes_of(adaptation.field, state_size, input_size)

    def in_turn(one: Callable) -> Callable:  # a loop instead of `jax.vmap` makes the C code small
        return lambda *stacked: jax.lax.map(lambda row: one(*row), stacked)

    def update(exact, state, x, u, periods):
        return exact.update(state, x, u, periods, in_turn)

    places = _add(file, adaptation, lambda exact, x: exact.begin(x), {"x": (d,)}, update, {"u": (m,), "periods": ()})
    more = (
        f"PARAMETERS {len(adaptation.names)}",
        f"TRUSTED {places['trusted'][0]} /* where the last good theta begins */",
    )
    about = _about("adapts a model while it runs", places, adaptation.names)
    return _written(file, folder, about, places, adaptation.dt, (f"STATE_SIZE {d}", f"INPUT_SIZE {m}", *more))


@entry
def export_filter_c(
    folder: str | Path, kalman: Any, *, name: str = "filter", double: bool = False, input_size: Size = None
) -> tuple[Path, Path]:
    """Write an `ExtendedKalmanFilter` as C99: NAME.h and NAME.c with NAME_begin and NAME_update.

    The functions are equivalent to the methods with these names. Errors are raised as by `export_c`.

    Args:
        folder: where the files are written; it is created if it does not exist.
        kalman: the filter.
        name: name of the files and prefix of the definitions, see `export_c`.
        double: compute in double instead of single precision.
        input_size: m; by default from the field's vehicle or its attribute of this name.

    Returns:
        The paths of the header and of the source.
    """
    system, file = kalman.system, CFile(name, double)
    d, m = sizes_of(system.field, system.size, input_size)

    def sample(x, u):
        return jnp.concatenate([system.output(each, x, u) for each in system.outputs])

    y = {"x": jax.eval_shape(sample, *(jax.ShapeDtypeStruct((n,), float) for n in (d, m))).shape}
    inputs = {"u": (m,)}
    places = _add(file, kalman, lambda exact, x, u: exact.begin(x, u), y | inputs, type(kalman).update, inputs)
    about = _about("estimates the states of a system", places)
    sizes = f"STATE_SIZE {d}", f"SAMPLE_SIZE {y['x'][0]}", f"INPUT_SIZE {m}"
    return _written(file, folder, about, places, kalman.dt, sizes)


def _add(file: CFile, estimator: Any, begin: Callable, first: Shapes, update: Callable, more: Shapes) -> Places:
    """Add the two functions of a filter, whose inputs are those of `first`, and x and `more`; return its state."""
    with jax.enable_x64(True):
        exact = in_double(estimator)
        start = jax.eval_shape(partial(begin, exact), *(jax.ShapeDtypeStruct(shape, float) for shape in first.values()))
        flat, unravel = ravel_pytree(jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), start))
        about = "The state of the filter before the first sample x."
        file.add("begin", about, lambda *given: ravel_pytree(begin(exact, *given))[0], first, ["state"])
        inputs = {"state": flat.shape, "x": first["x"], **more}
        about = UPDATE.format(
            f"periods times {file.name.upper()}_DT" if "periods" in more else f"{file.name.upper()}_DT"
        )

        def after(state, *given):
            return ravel_pytree(update(exact, unravel(state), *given))[0]

        file.add("update", about, after, inputs, ["next"])
    return _places(start)


def _written(
    file: CFile, folder: str | Path, about: str, places: Places, dt: float, sizes: Sequence[str]
) -> tuple[Path, Path]:
    total = f"SIZE {sum(size for _, size in places.values())} /* of the filter's state */"
    period = f"DT {file.printer.number(float(dt))} /* time between two samples [s] */"
    return file.write(folder, about, [*sizes, total, period])


def _places(state: Any) -> Places:
    """Return where each part of the state begins, and its size."""
    found, at = {}, 0
    for path, value in jax.tree_util.tree_leaves_with_path(state):
        found[jax.tree_util.keystr(path, simple=True, separator=".")] = at, value.size
        at += value.size
    return found


def _about(what: str, places: Places, theta: Sequence[str] = ()) -> str:
    layout = ",\n   ".join(f"{_plain(key)} at {start} ({size})" for key, (start, size) in places.items())
    lines = [f"A filter that {what}, written by hybrid_jax.", "", f"   state: {layout}."]
    if theta:
        changes = f"   theta contains the changes of {', '.join(map(_plain, theta))},"
        lines += [changes, "   in the standard deviations of their prior."]
    return "\n".join([*lines, "   No function allocates or keeps a state; results must not overlap what is read."])


def _plain(name: str) -> str:
    """Replace characters of a name that could end a comment."""
    return re.sub(r"[^A-Za-z0-9_.\[\]]", "_", name)
