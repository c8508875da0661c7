"""JAX programs as C: a walk over their operations, code as values, and a printer."""

__all__: list[str] = []
