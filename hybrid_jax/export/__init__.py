"""A model that leaves the lab: ẋ = f(x, u), or a step x⁺ = F(x, u), for programs that know nothing of this library.

- `export_field`, `export_step`, `load_program`: StableHLO in a file, through `jax.export` (extra `export`).
- `casadi_function`, `casadi_step`: a CasADi function, for optimal control and C code (extra `casadi`).

An example stands in docs/export.md.
"""

from hybrid_jax.export.casadi_functions import casadi_function, casadi_step
from hybrid_jax.export.stablehlo import Program, export_field, export_step, load_program

__all__ = ["Program", "casadi_function", "casadi_step", "export_field", "export_step", "load_program"]
