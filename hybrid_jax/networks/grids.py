"""Networks on periodic grids: the same small network at every point, pointwise or on a neighbourhood."""

from functools import reduce
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from hybrid_jax import checks
from hybrid_jax.dynamics.base import AbstractVectorField, as_field
from hybrid_jax.dynamics.grids import Grid
from hybrid_jax.networks.mlp import ResidualNetwork, residual_network
from hybrid_jax.networks.normalisation import AbstractScaling


class GridNetwork(AbstractVectorField):
    """A network that is the same at each point of a grid. It reads u and the kernel × … × kernel points around it.

    A kernel of 1 is a pointwise reaction. A kernel of 3 is a convolution of 3 × 3, then one of 1 × 1; unlike a kernel
    of 1, it can express derivatives in space, for example the Laplacian.

    The neighbours are gathered for one product over all points, because on a CPU the derivative of XLA's convolution
    takes ten times as long. In training mode the hidden units are recomputed for the gradient (`jax.checkpoint`), which
    takes half the time and a twentieth of the memory.

    Attributes:
        network: the network that is evaluated at each point.
        grid: the grid of the state.
        kernel: number of points along each axis that the network reads, which should be odd.
    """

    accepts_batch: ClassVar[bool] = True

    network: ResidualNetwork
    grid: Grid = eqx.field(static=True)
    kernel: int = eqx.field(static=True, default=1)

    def __call__(self, x: Float[Array, " d *b"], u: Float[Array, " m *b"]) -> Float[Array, " d *b"]:
        return self.network(*self.points(x, u)).reshape(-1, *x.shape[1:])

    def linearize(self, x, u, dx, du):
        near, held = self.points(x, u)
        at_points = jax.vmap(jax.jacrev(lambda read: self.network(*jnp.split(read, [len(near)]))), 1, 2)
        slopes = at_points(jnp.concatenate([near, held]))  # (c, numbers read, points): the same for all columns
        moved = self.grid.moved(self.grid.fields(dx), self.kernel)
        read = [column.reshape(-1, dx.shape[1]) for fields in moved for column in fields]
        read += [row[None] for row in du[: len(held)]]
        columns = reduce(jnp.add, (slopes[:, i, :, None] * column for i, column in enumerate(read)))
        return self(x, u), columns.reshape(-1, dx.shape[1])

    def parameter_columns(self, x, u):
        found = jax.vmap(as_field(self.network).parameter_columns, 1, 1)(*self.points(x, u))
        return found.reshape(-1, found.shape[-1])

    def points(self, x: Float[Array, " d *b"], u: Float[Array, " m *b"]) -> tuple[Array, Array]:
        """Return the network's inputs, with a column for each point of each sample: neighbours (k, n) and u (m, n)."""
        near = jnp.concatenate(self.grid.moved(self.grid.fields(x), self.kernel))
        u = u[: self.network.weight_in.shape[1] - len(near)]
        held = jnp.broadcast_to(jnp.expand_dims(u, (*self.grid.axes,)), (len(u), *near.shape[1:]))
        return near.reshape(len(near), -1), held.reshape(len(u), near[0].size)

    def neighbour_weights(self) -> Float[Array, "h k"]:
        """Return the first layer's weights for the values at all points except the centre."""
        read = self.grid.components * self.kernel ** len(self.grid.shape)
        blocks = self.network.weight_in[:, :read].reshape(len(self.network.weight_in), -1, self.grid.components)
        middle = blocks.shape[1] // 2
        return jnp.concatenate([blocks[:, :middle], blocks[:, middle + 1 :]], axis=1).reshape(len(blocks), -1)

    def train_batch(self, x, u):
        @jax.checkpoint
        def evaluate(network, x, u):
            return as_field(network).train_batch(*self.points(x, u)).reshape(x.shape)

        return evaluate(self.network, x, u)

    def update_running_stats(self, x, u):
        moved = as_field(self.network).update_running_stats(*self.points(x, u))
        return eqx.tree_at(lambda field: field.network, self, moved)


def grid_network(
    grid: Grid,
    input_size: int,
    key: PRNGKeyArray,
    *,
    kernel: int = 1,
    hidden: int = 32,
    activation: str = "tanh",
    norm: str = "none",
    scaling: AbstractScaling | None = None,
) -> GridNetwork:
    """Make a network that is the same at each point of a grid, with the paper's initial weights.

    Args:
        grid: the grid of the state.
        input_size: m, the size of u, which the network reads at each point; 0 if it does not depend on u.
        kernel: number of points along each axis that it reads. It should be odd, for example 3 for a convolution.
        hidden: number of hidden units at each point.
        activation: activation of the hidden units, by default smooth; see `residual_network`.
        norm: normalisation of the hidden units, by default none; see `residual_network`.
        scaling: scaling of inputs and outputs; see `residual_network`.

    Raises:
        ValueError: if the kernel is even or wider than the grid, or an argument of `residual_network` is invalid.
    """
    checks.count("kernel", kernel)
    if kernel % 2 == 0 or kernel > min(grid.shape):
        raise ValueError(f"kernel must be odd and at most {min(grid.shape)}, the grid's shortest side, got {kernel}")
    read = grid.components * kernel ** len(grid.shape)
    options = {"hidden": hidden, "activation": activation, "norm": norm, "scaling": scaling}
    network = residual_network(read, input_size, key, outputs=grid.components, **options)  # pyright: ignore[reportArgumentType]
    return GridNetwork(network, grid, kernel)
