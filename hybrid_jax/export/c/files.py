"""A header and a source of C99 with functions translated from JAX, which need only math.h and do not allocate."""

import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import jax

from hybrid_jax import checks
from hybrid_jax.codegen.loops import Tables
from hybrid_jax.codegen.operations import called, define, entries
from hybrid_jax.codegen.printer import CPrinter
from hybrid_jax.io.files import write_atomic

Shape = tuple[int, ...]
HEADER = """\
/* {about} */
#ifndef {NAME}_H
#define {NAME}_H

{constants}

#ifdef __cplusplus
extern "C" {{
#endif

{declarations}

#ifdef __cplusplus
}}
#endif
#endif
"""
SOURCE = """\
/* See {name}.h; written by hybrid_jax. */
#include "{name}.h"

#include <math.h>

typedef {type} real;

{functions}
{definitions}
"""


class CFile:
    """NAME.h and NAME.c, to which functions of arrays are added one by one."""

    def __init__(self, name: str, double: bool):
        # A file math.h would hide the header that the source includes.
        if not isinstance(name, str) or not re.fullmatch("[a-z][a-z0-9_]*", name) or name == "math":
            raise ValueError(f"name must be a lower-case C identifier, got {checks.short_repr(name)}")
        self.name, self.type = name, "double" if double else "float"
        self.tables, self.printer = Tables(double), CPrinter(double)
        self.declarations, self.definitions = list[str](), dict[str, str]()

    def add(
        self, name: str, about: str, function: Callable, inputs: Mapping[str, Shape], outputs: Sequence[str]
    ) -> Callable:
        """Add NAME_name and return the function that later ones call, which JAX does not trace again.

        Args:
            name: of the function.
            about: what it does, for the header.
            function: from arrays to a list of arrays.
            inputs: shape of each input; without axes it is a number.
            outputs: name of each output.
        """
        program = jax.make_jaxpr(function)(*(jax.ShapeDtypeStruct(shape, float) for shape in inputs.values()))
        define(self.tables, name, program, [entries(key, shape) for key, shape in inputs.items()], outputs)
        inputs = {key: shape for key, shape in inputs.items() if 0 not in shape}
        results = {key: one.shape for key, one in zip(outputs, program.out_avals, strict=True)}
        signature = f"void {self.name}_{name}({self._declared(inputs, 'const ')},\n    {self._declared(results)})"
        passed = [("&" if not shape else "") + k + "[0]" * (len(shape) == 2) for k, shape in (inputs | results).items()]
        self.declarations.append(f"/* {about} */\n{signature};\n")
        self.definitions[name] = f"{signature} {{ {name}({', '.join(passed)}); }}\n"

        def later(*arrays):
            return function(*arrays)

        later.__name__ = called(name)
        return jax.jit(later)

    def _declared(self, shapes: Mapping[str, Shape], kind: str = "") -> str:
        dimensions = {key: "".join(f"[{size}]" for size in shape) for key, shape in shapes.items()}
        return ", ".join(f"{kind if one else ''}{self.type} {key}{one}" for key, one in dimensions.items())

    def write(self, folder: str | Path, about: str, constants: Sequence[str]) -> tuple[Path, Path]:
        """Write both files; constants are "SIZE value", with a comment if you like."""
        parts = {"name": self.name, "NAME": self.name.upper(), "type": self.type, "about": about}
        parts["constants"] = "\n".join(f"#define {self.name.upper()}_{one}" for one in constants)
        parts["declarations"] = "\n".join(self.declarations).strip()
        parts["functions"] = self.printer.file(self.tables, self.definitions)
        parts["definitions"] = "\n".join(self.definitions.values()).strip()
        paths = Path(folder) / f"{self.name}.h", Path(folder) / f"{self.name}.c"
        for path, template in zip(paths, (HEADER, SOURCE), strict=True):
            write_atomic(path, template.format(**parts))
        return paths
