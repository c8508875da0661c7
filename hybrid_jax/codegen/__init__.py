"""Translate JAX programs to C: walk over the operations, build code as values, and print it."""

__all__: list[str] = []
