"""Interpolation between the nodes of a rectangular grid of two dimensions.

Linear interpolation is monotone: its weights are not negative and sum to one, so larger values at the nodes give larger
values between them. Cubic interpolation is more accurate for smooth values. Limited to the values of the four
surrounding corners (Bermejo and Staniforth 1992), it does not overshoot at ridges.
"""

import math
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float


class Grid(NamedTuple):
    """Nodes of a rectangle; hashable."""

    low: tuple[float, ...]
    steps: tuple[float, ...]
    """Distance between neighbouring nodes along each side."""
    shape: tuple[int, ...]
    circle: tuple[bool, ...]
    """Whether a side is a circle: its last node is its first and is not stored."""

    @property
    def nodes(self) -> Float[np.ndarray, "A B 2"]:
        """Coordinates of all nodes."""
        sides = zip(self.low, self.steps, self.shape, strict=True)
        axes = [start + step * np.arange(count) for start, step, count in sides]
        return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)


class Stencil(NamedTuple):
    """Nodes around some states along both sides, and their weights, for `read`."""

    rows: Array
    """[k, ...]."""
    columns: Array
    row_weights: Array
    """[k, ...], which sum to one."""
    column_weights: Array


def linear(grid: Grid, x: Array) -> Stencil:
    """Returns the stencil of bilinear interpolation at states x [..., 2]; beyond an edge, the edge's value applies."""
    return _stencil(grid, x, (0, 1))


def read(values: Array, at: Stencil) -> Array:
    """Interpolates values at the nodes [A, B] to the states of a stencil."""
    count = at.rows.shape[0]
    total = jnp.zeros(at.rows.shape[1:], values.dtype)
    for i in range(count):
        row = sum(at.column_weights[j] * values[at.rows[i], at.columns[j]] for j in range(count))
        total += at.row_weights[i] * row
    return total


def interpolated(grid: Grid, values: Array, x: Any) -> Array:
    """Interpolates values at the nodes [A, B], such as V, to states [..., 2] by limited cubics."""
    smooth, around = (_stencil(grid, jnp.asarray(x), offsets) for offsets in ((-1, 0, 1, 2), (0, 1)))
    corners = jnp.stack([values[row, column] for row in around.rows for column in around.columns])
    return jnp.clip(read(values, smooth), jnp.min(corners, axis=0), jnp.max(corners, axis=0))


def one_sided_slopes(grid: Grid, values: Array, axis: int) -> tuple[Array, Array]:
    """Returns backward and forward difference quotients along an axis; at an edge both are the one that exists."""
    forward = (jnp.roll(values, -1, axis) - values) / grid.steps[axis]
    backward = jnp.roll(forward, 1, axis)
    if grid.circle[axis]:
        return backward, forward
    place = jnp.arange(values.shape[axis]).reshape([-1 if side == axis else 1 for side in range(values.ndim)])
    first, last = place == 0, place == values.shape[axis] - 1
    return jnp.where(first, forward, backward), jnp.where(last, backward, forward)


def _stencil(grid: Grid, x: Array, offsets: tuple[int, ...]) -> Stencil:
    """Returns the stencil of Lagrange polynomials through the nodes at these offsets from a state's cell."""
    nodes, weights = [], []
    for axis, (low, step, count, circle) in enumerate(zip(*grid, strict=True)):
        place = (x[..., axis] - low) / step
        place = place if circle else jnp.clip(place, 0.0, count - 1.0)
        # At an edge all nodes lie on one side of the cell.
        cell = jnp.floor(place) if circle else jnp.clip(jnp.floor(place), -offsets[0], count - 1.0 - offsets[-1])
        s = place - cell
        own = [math.prod((s - k) / (j - k) for k in offsets if k != j) for j in offsets]
        around = cell.astype(jnp.int32) + jnp.array(offsets).reshape(-1, *[1] * place.ndim)
        nodes.append(jnp.mod(around, count) if circle else around)
        weights.append(jnp.stack(own))
    return Stencil(*nodes, *weights)
