"""Export ẋ = f(x, u), or a step x⁺ = F(x, u), for programs that do not use this library.

- `export_field`, `export_step`, `load_program`: StableHLO in a file, through `jax.export` (extra `export`).
- `casadi_function`, `casadi_step`: a CasADi function, for optimal control and C code (extra `casadi`).

See docs/howto/export.md for an example.
"""

from hybrid_jax.export.casadi_functions import casadi_function, casadi_step
from hybrid_jax.export.stablehlo import Program, export_field, export_step, load_program

__all__ = ["Program", "casadi_function", "casadi_step", "export_field", "export_step", "load_program"]
