"""Systems of equations with small matrices, one after the other also under `vmap`.

On a CPU jaxlib shares a batch of factorisations out to the threads that run programs, and waits for them in one of
these. Two batches at once, in one program or on two devices, can then wait for each other for ever.
"""

import jax
from jaxtyping import Array, Float


@jax.custom_batching.sequential_vmap
def solve(matrix: Float[Array, "n n"], right: Float[Array, " n *k"]) -> Float[Array, " n *k"]:
    """matrix⁻¹ right for a positive definite matrix, by Cholesky."""
    return jax.scipy.linalg.cho_solve(jax.scipy.linalg.cho_factor(matrix), right)
