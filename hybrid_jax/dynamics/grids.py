"""Fields on periodic grids: a state of `components` × grid points, its Laplacian, and diffusion as physics."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from math import prod
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hybrid_jax import checks
from hybrid_jax.dynamics.base import AbstractVectorField
from hybrid_jax.state_space import Quantity, StateSpace
from hybrid_jax.trajectories import Trajectories, check

REAL_AXIS = 2.785  # RK4 is stable for z = λ dt from −2.785 to 0 (Hairer and Wanner, Solving ODEs II, Sec. IV.2)
SEAM = 3.0  # largest step across the edge over the usual step between neighbours; 1 in periodic data


@dataclass(frozen=True)
class Grid:
    """A periodic grid of equal spacing with one or more quantities at each point.

    A state lists one quantity after the other, each in row-major order. Further axes are samples. Methods take and
    return arrays of shape (components, *shape, *b), as `fields` does.

    Attributes:
        shape: points along each axis of space, which should be at least three.
        spacing: distance between neighbours along every axis [m].
        components: number of quantities at each point.

    Raises:
        ValueError: if a side has fewer than three points, the spacing is not positive, or there are no components.
    """

    shape: tuple[int, ...]
    spacing: float = 1.0
    components: int = 1

    def __post_init__(self):
        if not isinstance(self.shape, tuple) or not self.shape:
            raise ValueError(f"shape must be a tuple such as (32, 32), got {checks.short_repr(self.shape)}")
        for side in self.shape:
            checks.count("shape: each side", side, least=3)
        checks.positive("spacing", self.spacing)
        checks.count("components", self.components)

    @property
    def points(self) -> int:
        """The number of grid points."""
        return prod(self.shape)

    @property
    def size(self) -> int:
        """The size d of a state."""
        return self.components * self.points

    @property
    def state_space(self) -> StateSpace:
        """The state space, with one quantity for each component."""
        components = (Quantity(f"component {i}", self.points, uniform=True) for i in range(self.components))
        return StateSpace(tuple(components))

    @property
    def axes(self) -> range:
        """The indices of the axes of space in an array that `fields` returns."""
        return range(1, 1 + len(self.shape))

    def fields(self, x: Float[Array, " d *b"]) -> Float[Array, " c *cells"]:
        """Return the state as an array (components, *shape, *b) over the grid; ValueError if its size differs."""
        if x.shape[0] != self.size:
            sides = " × ".join(map(str, (self.components, *self.shape)))
            raise ValueError(f"a grid of {sides} needs states of {self.size} numbers, got {x.shape[0]}")
        return x.reshape(self.components, *self.shape, *x.shape[1:])

    def laplacian(self, fields: Float[Array, " c *cells"]) -> Float[Array, " c *cells"]:
        """Compute Δ of each component: Σ (neighbour − value) / spacing² over neighbours, with an error of O(spacing²).

        Args:
            fields: as returned by `fields`.
        """
        padded = self._padded(fields, 1)
        inside = {axis: slice(1, -1) for axis in self.axes}

        def moved(axis: int, to: slice):
            return padded[tuple((inside | {axis: to}).get(i, slice(None)) for i in range(padded.ndim))]

        near = [moved(axis, to) for axis in self.axes for to in (slice(2, None), slice(None, -2))]
        return (sum(near[1:], near[0]) - len(near) * fields) / self.spacing**2

    def moved(self, fields: Float[Array, " c *cells"], kernel: int) -> list[Float[Array, " c *cells"]]:
        """Return the values at each of the kernel × … × kernel neighbours, in row-major order of their offsets.

        Args:
            fields: as returned by `fields`.
            kernel: number of points along each side of the neighbourhood, which should be odd.
        """
        if kernel == 1:
            return [fields]
        padded, at = self._padded(fields, kernel // 2), product(range(kernel), repeat=len(self.shape))
        shifts = (tuple(slice(i, i + n) for i, n in zip(place, self.shape, strict=True)) for place in at)
        return [padded[(slice(None), *shift)] for shift in shifts]

    def _padded(self, fields: Float[Array, " c *cells"], reach: int) -> Float[Array, " c *cells"]:
        """Add `reach` points at each edge, copied from the opposite edge."""
        return jnp.pad(fields, [(reach * (i in self.axes),) * 2 for i in range(fields.ndim)], mode="wrap")

    def largest_step(self, diffusivity: float | Sequence[float] | np.ndarray | Array) -> float:
        """Return the longest step [s] for which RK4 is stable, by linear theory; it is infinite without diffusion.

        The Laplacian's most negative eigenvalue is −4 n / spacing² in n dimensions, hence 2.785 spacing² / (4 n D).

        Args:
            diffusivity: one or several D [m²/s], of which the largest counts.
        """
        most = float(np.max(np.abs(np.asarray(diffusivity))))
        return REAL_AXIS * self.spacing**2 / (4 * len(self.shape) * most) if most else float("inf")


def check_grid(
    grid: Grid,
    windows: Trajectories,
    *,
    diffusivity: float | Sequence[float] | np.ndarray | Array = 0.0,
    substeps: int = 1,
    name: str = "windows",
) -> None:
    """Raise ValueError if windows are not on the grid, not periodic, or sampled too slowly for the solver's steps.

    You should call this before you fit. Differences across an edge may be three times as large as between neighbours.
    If samples are too slow, the message contains the number of substeps that you need.

    Args:
        grid: the grid of each state.
        windows: the data.
        diffusivity: one or several D [m²/s], of which the largest bounds the step; 0 for no bound.
        substeps: number of solver steps in each interval of the windows.
        name: name of the windows in messages.
    """
    size = check(windows, name).x0.shape[-1]
    if size != grid.size:
        sides = " × ".join(map(str, (grid.components, *grid.shape)))
        raise ValueError(f"{name}: states of {grid.size} numbers expected for a grid of {sides}, got {size}")
    states = np.concatenate([windows.x0, windows.x[:, -1]]).T
    fields = np.asarray(grid.fields(states))  # type: ignore[arg-type]
    for axis in grid.axes:
        steps = np.square(np.diff(fields, axis=axis, append=fields.take([0], axis)))
        inside, seam = np.sqrt(np.mean(steps.take(range(grid.shape[axis - 1] - 1), axis))), steps.take([-1], axis)
        if (across := np.sqrt(np.mean(seam))) > SEAM * inside:
            raise ValueError(
                f"{name}: not periodic along axis {axis - 1}: the step across the edge is {across:.3g}, between "
                f"neighbours {inside:.3g}; the grid's derivatives join opposite edges"
            )
    checks.count("substeps", substeps)
    step, bound = windows.dt / substeps, grid.largest_step(diffusivity)
    if step > bound:
        raise ValueError(
            f"{name}: a step of {step:.3g} s is unstable, RK4 needs at most {bound:.3g} s for these diffusivities and "
            f"this grid; use RK4(substeps={int(np.ceil(windows.dt / bound))}) or more"
        )


class Diffusion(AbstractVectorField):
    """Diffusion ẋ = D Δx on a grid.

    Attributes:
        log_diffusivity: logarithm of D [m²/s] of each component (c).
        grid: the grid of the state.
    """

    accepts_batch: ClassVar[bool] = True

    log_diffusivity: Float[Array, " c"]
    grid: Grid = eqx.field(static=True)

    def __call__(self, x: Float[Array, " d *b"], u: Float[Array, " m *b"]) -> Float[Array, " d *b"]:
        spread = self.grid.laplacian(self.grid.fields(x))
        return (jnp.exp(self.log_diffusivity).reshape(-1, *(1,) * (spread.ndim - 1)) * spread).reshape(x.shape)

    @property
    def state_space(self):
        return self.grid.state_space

    def linearize(self, x, u, dx, du):
        return self(x, u), self(dx, u)  # it is linear

    def theta(self) -> dict[str, Float[Array, " c"]]:
        """Return the diffusivities [m²/s]."""
        return {"diffusivity": jnp.exp(self.log_diffusivity)}


def diffusion(grid: Grid, diffusivity: Sequence[float]) -> Diffusion:
    """Make a `Diffusion` from diffusivities.

    Args:
        grid: the grid of the state.
        diffusivity: D [m²/s] of each component; ValueError if one is not positive, or their number differs.
    """
    if len(diffusivity) != grid.components:
        raise ValueError(f"diffusivity: {grid.components} expected, one for each component, got {len(diffusivity)}")
    for value in diffusivity:
        checks.positive("diffusivity", value)
    return Diffusion(jnp.log(jnp.asarray(diffusivity, float)), grid)
