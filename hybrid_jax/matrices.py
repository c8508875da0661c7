"""Solve systems with small matrices one after the other, also under `vmap`.

On a CPU, jaxlib distributes a batch of factorisations over the threads that run programs and waits for them in one
of these threads, so two batches at once, in one program or on two devices, can deadlock.
"""

import jax
from jaxtyping import Array, Float


@jax.custom_batching.sequential_vmap
def solve(matrix: Float[Array, "n n"], right: Float[Array, " n *k"]) -> Float[Array, " n *k"]:
    """matrix⁻¹ right for a positive definite matrix, by Cholesky."""
    return jax.scipy.linalg.cho_solve(jax.scipy.linalg.cho_factor(matrix), right)
