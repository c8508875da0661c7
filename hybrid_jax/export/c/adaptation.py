"""The step of an `OnlineAdaptation` as C99, with its state as an array of `ravel_pytree`."""

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree

from hybrid_jax.codegen.loops import Tables
from hybrid_jax.codegen.printer import CPrinter
from hybrid_jax.export.c.fields import body_of, check_name, written
from hybrid_jax.export.c.templates import ADAPTATION_HEADER, ADAPTATION_SOURCE
from hybrid_jax.export.program import Size, sizes_of
from hybrid_jax.runtime import entry


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

    The functions do what the methods with these names do. It raises the errors of `export_c`.

    Args:
        folder: where the files are written; it is created if it does not exist.
        adaptation: the filter.
        name: name of the files and prefix of the definitions, see `export_c`.
        double: compute in double precision, else in single.
        state_size: d; by default from the filter's field.
        input_size: m; by default from the filter's field.

    Returns:
        The paths of the header and of the source.
    """
    check_name(name)
    d, m = sizes_of(adaptation.field, state_size, input_size)
    tables, printer = Tables(double), CPrinter(double)
    with jax.enable_x64(True):
        exact = jax.tree.map(lambda leaf: jnp.asarray(leaf, float) if eqx.is_inexact_array(leaf) else leaf, adaptation)
        first = exact.begin(jnp.zeros(d))
        flat, unravel = ravel_pytree(first)
        sizes = {"state": flat.size, "x": d, "u": m, "elapsed": 1}
        likes = {key: jax.ShapeDtypeStruct((size,), float) for key, size in sizes.items()}

        def in_turn(one: Callable) -> Callable:  # a loop in the place of `jax.vmap` makes the C code small
            return lambda *stacked: jax.lax.map(lambda row: one(*row), stacked)

        def update(state, x, u, elapsed):
            return [ravel_pytree(exact.update(unravel(state), x, u, elapsed[0], in_turn))[0]]

        def begin(x):
            return [ravel_pytree(exact.begin(x))[0]]

        stepped = body_of(update, list(likes.values()), tables, ("next",), tuple(likes))
        begun = body_of(begin, [likes["x"]], tables, ("state",), ("x",))
    parts = {"d": d, "m": m, "size": flat.size, "dt": printer.number(float(adaptation.dt))}
    parts |= {"elapsed": f"periods of {name.upper()}_DT ago"} | _parts(exact, first)
    parts |= printer.parts(tables, begin=begun, update=stepped)
    return written(folder, name, ADAPTATION_HEADER, ADAPTATION_SOURCE, parts)


def _parts(adaptation: Any, state: Any) -> dict[str, Any]:
    """Describe the layout of the state in words."""
    places, at = [], 0
    for path, value in jax.tree_util.tree_leaves_with_path(state):
        places.append((jax.tree_util.keystr(path, simple=True, separator="."), at, value.size))
        at += value.size
    return {
        "layout": ",\n   ".join(f"{_plain(key)} at {start} ({size})" for key, start, size in places),
        "names": ", ".join(map(_plain, adaptation.names)),
        "p": len(adaptation.names),
        "trusted": next(start for key, start, _ in places if key == "trusted"),
    }


def _plain(name: str) -> str:
    """Replace characters of a name that could end a comment."""
    return re.sub(r"[^A-Za-z0-9_.\[\]]", "_", name)
