"""The step of an `OnlineAdaptation` as C99, with its state as an array of `ravel_pytree`."""

import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree

from hybrid_jax.dynamics.base import in_double
from hybrid_jax.export.c.files import CFile
from hybrid_jax.export.program import Size, sizes_of
from hybrid_jax.runtime import entry

UPDATE = """\
The state after a sample x, NaN where nothing was measured. u is the mean input since the last update, which should be
   periods times {}_DT ago."""


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
    with jax.enable_x64(True):
        exact = in_double(adaptation)
        first = exact.begin(jnp.zeros(d))
        flat, unravel = ravel_pytree(first)

        def in_turn(one: Callable) -> Callable:  # a loop instead of `jax.vmap` makes the C code small
            return lambda *stacked: jax.lax.map(lambda row: one(*row), stacked)

        def update(state, x, u, periods):
            return ravel_pytree(exact.update(unravel(state), x, u, periods, in_turn))[0]

        def begin(x):
            return ravel_pytree(exact.begin(x))[0]

        file.add("begin", "The state of the filter before the first sample x.", begin, {"x": (d,)}, ["state"])
        inputs = {"state": flat.shape, "x": (d,), "u": (m,), "periods": ()}
        file.add("update", UPDATE.format(file.name.upper()), update, inputs, ["next"])
    places = _places(first)
    constants = [
        *(f"STATE_SIZE {d}", f"INPUT_SIZE {m}", f"PARAMETERS {len(adaptation.names)}"),
        f"SIZE {flat.size} /* of the filter's state */",
        f"TRUSTED {places['trusted'][0]} /* where the last good theta begins in it */",
        f"DT {file.printer.number(float(adaptation.dt))} /* time between two samples [s] */",
    ]
    return file.write(folder, _about(adaptation.names, places), constants)


def _places(state: Any) -> dict[str, tuple[int, int]]:
    """Return where each part of the state begins, and its size."""
    found, at = {}, 0
    for path, value in jax.tree_util.tree_leaves_with_path(state):
        found[jax.tree_util.keystr(path, simple=True, separator=".")] = at, value.size
        at += value.size
    return found


def _about(names: Sequence[str], places: Mapping[str, tuple[int, int]]) -> str:
    layout = ",\n   ".join(f"{_plain(key)} at {start} ({size})" for key, (start, size) in places.items())
    return f"""\
A filter that adapts a model while it runs, written by hybrid_jax.

   state: {layout}.
   theta contains the changes of {", ".join(map(_plain, names))},
   in the standard deviations of their prior.
   No function allocates or keeps a state; results must not overlap what is read."""


def _plain(name: str) -> str:
    """Replace characters of a name that could end a comment."""
    return re.sub(r"[^A-Za-z0-9_.\[\]]", "_", name)
