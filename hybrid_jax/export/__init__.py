"""Export ẋ = f(x, u), or a step x⁺ = F(x, u), for programs that do not use this library.

- `export_program`, `load_program`: StableHLO in a file, through `jax.export` (extra `export`).
- `casadi_function`: a CasADi function, for example for optimal control (extra `casadi`).
- `export_c`, `export_adaptation_c`, `export_filter_c`: C99 for a flight controller.
"""

from hybrid_jax.export.c.fields import export_c
from hybrid_jax.export.c.filters import export_adaptation_c, export_filter_c
from hybrid_jax.export.casadi_functions import casadi_function
from hybrid_jax.export.stablehlo import Program, export_program, load_program

__all__ = ["Program", "casadi_function"]
__all__ += ["export_adaptation_c", "export_c", "export_filter_c", "export_program", "load_program"]
