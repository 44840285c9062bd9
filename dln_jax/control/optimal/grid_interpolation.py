"""Interpolation between the nodes of a rectangular grid of two dimensions.

Linear interpolation is monotone: its weights are not negative and sum to one, so that larger values at the nodes give
larger values between them. Cubic interpolation is more accurate for smooth values. Limited to the values of the four
surrounding corners (Bermejo and Staniforth 1992) it does not overshoot at ridges.
"""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float


class Grid(NamedTuple):
    """Nodes of a rectangle; hashable."""

    low: tuple[float, ...]
    steps: tuple[float, ...]
    """Distance between neighbouring nodes on the sides."""
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
    """Nodes around some states on both sides, and their weights, for `read`."""

    rows: Array
    """[k, ...]."""
    columns: Array
    row_weights: Array
    """[k, ...], which sum to one."""
    column_weights: Array


def linear(grid: Grid, x: Array) -> Stencil:
    """Stencil of bilinear interpolation at states x [..., 2]; beyond an edge, the edge's value applies."""
    (rows, row_weights), (columns, column_weights) = (_linear(x[..., i], *side) for i, side in enumerate(_sides(grid)))
    return Stencil(rows, columns, row_weights, column_weights)


def read(values: Array, at: Stencil) -> Array:
    """Evaluates values at the nodes [A, B] at the states of a stencil."""
    count = at.rows.shape[0]
    total = jnp.zeros(at.rows.shape[1:], values.dtype)
    for i in range(count):
        row = sum(at.column_weights[j] * values[at.rows[i], at.columns[j]] for j in range(count))
        total += at.row_weights[i] * row
    return total


def interpolated(grid: Grid, values: Array, x: Any) -> Array:
    """Limited cubic interpolation of values at the nodes [A, B], such as V, at states [..., 2]."""
    x = jnp.asarray(x)
    (rows, row_weights), (columns, column_weights) = (_cubic(x[..., i], *side) for i, side in enumerate(_sides(grid)))
    smooth = read(values, Stencil(rows, columns, row_weights, column_weights))
    around = linear(grid, x)
    corners = jnp.stack([values[row, column] for row in around.rows for column in around.columns])
    return jnp.clip(smooth, jnp.min(corners, axis=0), jnp.max(corners, axis=0))


def one_sided_slopes(grid: Grid, values: Array, axis: int) -> tuple[Array, Array]:
    """Backward and forward difference quotients along an axis; at an edge both are the one that exists."""
    forward = (jnp.roll(values, -1, axis) - values) / grid.steps[axis]
    backward = jnp.roll(forward, 1, axis)
    if grid.circle[axis]:
        return backward, forward
    place = jnp.arange(values.shape[axis]).reshape([-1 if each == axis else 1 for each in range(values.ndim)])
    first, last = place == 0, place == values.shape[axis] - 1
    return jnp.where(first, forward, backward), jnp.where(last, backward, forward)


def _sides(grid: Grid) -> list[tuple[float, float, int, bool]]:
    return list(zip(grid.low, grid.steps, grid.shape, grid.circle, strict=True))


def _linear(x: Array, low: float, step: float, count: int, circle: bool) -> tuple[Array, Array]:
    """Two nodes [2, ...] around x on a side, and their weights."""
    place = (x - low) / step
    if not circle:
        place = jnp.clip(place, 0.0, count - 1.0)
    cell = jnp.floor(place) if circle else jnp.clip(jnp.floor(place), 0.0, count - 2.0)
    nodes = cell.astype(jnp.int32) + jnp.arange(2).reshape(2, *[1] * x.ndim)
    return (jnp.mod(nodes, count) if circle else nodes), jnp.stack([1 - (place - cell), place - cell])


def _cubic(x: Array, low: float, step: float, count: int, circle: bool) -> tuple[Array, Array]:
    """Four nodes [4, ...] about x on a side, and the weights of Lagrange's polynomial."""
    place = (x - low) / step
    if not circle:
        place = jnp.clip(place, 0.0, count - 1.0)
    # At an edge the four nodes lie on one side of the cell.
    first = jnp.floor(place) if circle else jnp.clip(jnp.floor(place), 1.0, count - 3.0)
    s = place - first
    weights = jnp.stack(
        [
            -s * (s - 1) * (s - 2) / 6,
            (s + 1) * (s - 1) * (s - 2) / 2,
            -(s + 1) * s * (s - 2) / 2,
            (s + 1) * s * (s - 1) / 6,
        ]
    )
    nodes = first.astype(jnp.int32) + jnp.arange(-1, 3).reshape(4, *[1] * x.ndim)
    return (jnp.mod(nodes, count) if circle else nodes), weights
