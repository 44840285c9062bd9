"""The value of a control problem of two states on a grid: an independent solution that others are measured against.

    V(x) = min over u of  integral from 0 to dt of e^(-rho t) (q + g) dt + e^(-rho dt) V(x(dt))

A semi-Lagrangian scheme (Falcone and Ferretti 2014): the feet x(dt) of characteristics are found by the classical
Runge-Kutta method with held controls, and V there by bicubic interpolation that is limited to the values of the four
corners around (Bermejo and Staniforth 1992), without which it would overshoot at ridges. Policies and values are
improved in turn (Howard 1960): controls are the best of a list, refined by a parabola. Coarse grids start fine ones.
"""

import math
from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from dln_jax.control.optimal.boxes import circles
from dln_jax.control.optimal.flow import Flow, flow
from dln_jax.control.optimal.problem import ControlProblem
from dln_jax.types import InputError, require_positive

CONTROLS = 25
"""Of the list."""
IMPROVEMENTS, SWEEPS = 40, 60
"""Of the policy at most on each grid, and of the value between two of them."""


class Grid(NamedTuple):
    """Nodes of a rectangle; hashable."""

    low: tuple[float, ...]
    steps: tuple[float, ...]
    """Distances of nodes."""
    shape: tuple[int, ...]
    circle: tuple[bool, ...]
    """Whether the last node of a side, which is not stored, is its first."""

    @property
    def nodes(self) -> Float[np.ndarray, "A B 2"]:
        """All."""
        sides = zip(self.low, self.steps, self.shape, strict=True)
        axes = [start + step * np.arange(count) for start, step, count in sides]
        return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)


class GridValue(NamedTuple):
    """V and the best control at the nodes."""

    grid: Grid
    V: Float[Array, "A B"]
    u: Float[Array, "A B"]
    change: Float[Array, ""]
    """The largest of V in the last sweep."""


def solve_on_grid(
    problem: ControlProblem,
    points: Sequence[int],
    *,
    low: Any,
    high: Any,
    most: float,
    dt: float = 0.02,
    tolerance: float = 1e-7,
    start: GridValue | None = None,
) -> GridValue:
    """The value on the last of some grids, each of so many points a side, the coarsest first.

    Args:
        problem: of two states and one control.
        points: of each side of each grid; on a circle its last node is its first.
        low: corner of the rectangle [2]. Trajectories that would leave it stay on its edge: take it so large that
            those of interest do not.
        high: the other corner.
        most: size of the largest control, where its cost is finite.
        dt: s. Controls are held for it, which costs O(dt²).
        tolerance: of V, relative to its largest, in a sweep.
        start: a solution on a coarser grid.

    Raises:
        InputError: another number of states, or settings out of range.
    """
    low, high = np.asarray(low, float), np.asarray(high, float)
    if low.shape != (2,) or high.shape != (2,) or not (low < high).all():
        raise InputError(f"the rectangle is {low} to {high}; expected two ascending numbers each, for two states")
    require_positive(most=most, dt=dt, tolerance=tolerance, least_points=min(points) - 4)
    circle = tuple(bool(each) for each in circles(problem))
    step = flow(problem, dt)
    found = start
    for count in points:
        shape = tuple(count - 1 if round_ else count for round_ in circle)
        grid = Grid(tuple(low.tolist()), tuple(((high - low) / (count - 1)).tolist()), shape, circle)
        V = jnp.zeros(shape) if found is None else interpolated(found.grid, found.V, grid.nodes)
        found = GridValue(grid, *_iterate(step, grid, math.exp(-problem.discount * dt), V, most, tolerance))
    if found is None:
        raise InputError("there are no points; expected one number for each grid")
    return found


@partial(jax.jit, static_argnums=(0, 1))
def _iterate(step: Flow, grid: Grid, discount: Any, V: Array, most: Any, tolerance: Any) -> tuple[Array, Array, Array]:
    nodes = jnp.asarray(grid.nodes)
    over = lambda function: jax.vmap(jax.vmap(function))  # noqa: E731
    listed = jnp.linspace(-most, most, CONTROLS)
    spacing = listed[1] - listed[0]

    def improved(V: Array) -> Array:
        """The best control at each node."""

        def total(u: Array) -> Array:
            after, cost = over(lambda x: step(x, u[None]))(nodes)
            return cost + discount * _at(grid, V, after)

        totals = jax.lax.map(total, listed)
        best = jnp.clip(jnp.argmin(totals, axis=0), 1, CONTROLS - 2)
        left, middle, right = (jnp.take_along_axis(totals, (best + side)[None], axis=0)[0] for side in (-1, 0, 1))
        bend = left - 2 * middle + right
        offset = jnp.where(bend > 0, 0.5 * (left - right) / jnp.where(bend > 0, bend, 1.0), 0.0)
        return listed[best] + spacing * jnp.clip(offset, -1.0, 1.0)

    def sweeps(V: Array, u: Array) -> tuple[Array, Array]:
        after, cost = over(lambda x, u: step(x, u[None]))(nodes, u)
        places = _places(grid, after)

        def sweep(carry: tuple[Array, Array], _: Any) -> tuple[tuple[Array, Array], None]:
            V, _ = carry
            new = cost + discount * _read(V, places)
            return (new, jnp.max(jnp.abs(new - V))), None

        return jax.lax.scan(sweep, (V, jnp.asarray(jnp.inf)), length=SWEEPS)[0]

    def going(carry: tuple[Array, ...]) -> Array:
        number, V, _, change = carry
        return (number < IMPROVEMENTS) & (change > tolerance * jnp.max(jnp.abs(V)))

    def iterate(carry: tuple[Array, ...]) -> tuple[Array, ...]:
        number, V, _, _ = carry
        u = improved(V)
        V, change = sweeps(V, u)
        return number + 1, V, u, change

    start = (jnp.asarray(0), V, jnp.zeros_like(V), jnp.asarray(jnp.inf))
    _, V, u, change = jax.lax.while_loop(going, iterate, start)
    return V, u, change


def interpolated(grid: Grid, values: Array, x: Any) -> Array:
    """Values of the nodes [A, B], such as V, at states [..., 2]."""
    return _at(grid, values, jnp.asarray(x))


class _Places(NamedTuple):
    """Where to read in the grid: nodes about each state with their weights, and those of the cell that it is in."""

    rows: Array
    columns: Array
    row_weights: Array
    column_weights: Array
    cell_rows: Array
    cell_columns: Array


def _at(grid: Grid, values: Array, x: Array) -> Array:
    return _read(values, _places(grid, x))


def _places(grid: Grid, x: Array) -> _Places:
    sides = zip(grid.low, grid.steps, grid.shape, grid.circle, strict=True)
    (rows, row_weights, cell_rows), (columns, column_weights, cell_columns) = (
        _cubic(x[..., i], *side) for i, side in enumerate(sides)
    )
    return _Places(rows, columns, row_weights, column_weights, cell_rows, cell_columns)


def _cubic(x: Array, low: float, step: float, count: int, circle: bool) -> tuple[Array, Array, Array]:
    """Four nodes [4, ...] about x on a side, the weights of Lagrange's polynomial, and the two nodes around x."""
    place = (x - low) / step
    cell = jnp.floor(place)
    if not circle:
        place = jnp.clip(place, 0.0, count - 1.0)
        cell = jnp.clip(cell, 0.0, count - 2.0)
    # At an edge the four nodes are to one side of the cell.
    first = cell if circle else jnp.clip(cell, 1.0, count - 3.0)
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
    around = cell.astype(jnp.int32) + jnp.arange(2).reshape(2, *[1] * x.ndim)
    return (jnp.mod(nodes, count), weights, jnp.mod(around, count)) if circle else (nodes, weights, around)


def _read(values: Array, at: _Places) -> Array:
    total = jnp.zeros(at.rows.shape[1:], values.dtype)
    for i in range(4):
        row = sum(at.column_weights[j] * values[at.rows[i], at.columns[j]] for j in range(4))
        total += at.row_weights[i] * row
    corners = jnp.stack([values[row, column] for row in at.cell_rows for column in at.cell_columns])
    return jnp.clip(total, jnp.min(corners, axis=0), jnp.max(corners, axis=0))
