"""Value of a two-state control problem on a grid: an independent reference for other solutions.

    V(x) = min over u of  integral from 0 to dt of e^(-rho t) (q + g) dt + e^(-rho dt) V(x(dt))

The scheme is semi-Lagrangian (Falcone and Ferretti 2014): the classical Runge-Kutta method with held controls gives the
feet x(dt) of characteristics, and linear interpolation gives V there. The scheme is then monotone with a unique fixed
point: it converges to the viscosity solution, and Howard's policy iteration (1960), which never raises V, converges to
the fixed point. (With cubic interpolation it did not at ridges.) The candidates for a control are the present control,
a list over the range, and u = grad g*(-Bᵀ V_x) for the slopes of V on both sides. Coarse grids initialise fine ones.
Cubic interpolation reads the result; limited to the values of the four surrounding corners, it does not overshoot at
ridges (Bermejo and Staniforth 1992).

Linear interpolation causes an error of O(h²/dt) and held controls an error of O(dt²), so dt should be as long as the
controls allow. The change between two grids estimates the distance of V from its limit; `extrapolated` removes most of
it where V is smooth. `lookahead` gives the policy of V. The cost of this policy bounds the true value from above.
"""

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Bool, Float, Int

from dln_jax.control.optimal.problem import ControlProblem, Flow, circles, flow, optimal_control
from dln_jax.control.state_space import Law
from dln_jax.solvers.ending import Ending
from dln_jax.types import InputError, require_positive

CONTROLS = 25
"""Number of listed controls."""
SWEEPS = 20_000
"""Largest number of sweeps of the value between two improvements of the policy."""


class Grid(NamedTuple):
    """Nodes of a rectangle; hashable."""

    low: tuple[float, ...]
    steps: tuple[float, ...]
    """Distance between neighbouring nodes along each side."""
    shape: tuple[int, ...]
    circle: tuple[bool, ...]
    """True for a side that is a circle: its last node equals the first and is not stored."""

    @property
    def nodes(self) -> Float[np.ndarray, "A B 2"]:
        """Coordinates of all nodes."""
        sides = zip(self.low, self.steps, self.shape, strict=True)
        axes = [start + step * np.arange(count) for start, step, count in sides]
        return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)


class GridValue(NamedTuple):
    """V and the best control at the nodes."""

    grid: Grid
    V: Float[Array, "A B"]
    u: Float[Array, "A B"]
    change: Float[Array, ""]
    """Largest |V - min over u of the right-hand side|, relative to the largest V."""
    ending: Int[Array, ""]
    """An `Ending`."""

    @property
    def converged(self) -> Bool[Array, ""]:
        """True if `change` is within the tolerance; otherwise `solvers.ending.reason(ending)` gives the reason."""
        return self.ending == Ending.CONVERGED


def solve_on_grid(
    problem: ControlProblem,
    points: Sequence[int],
    *,
    low: Any,
    high: Any,
    limit: float,
    dt: float = 0.05,
    tolerance: float = 1e-7,
    improvements: int = 100,
    start: GridValue | None = None,
) -> GridValue:
    """Solves for the value on several grids, the coarsest first, and returns the value on the last grid.

    Args:
        problem: a problem with two states and one control.
        points: number of nodes per side, for every grid; on a circle the last node is the first.
        low: lower corner of the rectangle [2]. Trajectories cannot leave it and stay on its edge, so make it large
            enough.
        high: upper corner.
        limit: largest magnitude of the control; the cost must be finite there.
        dt: holding time of controls, s, with an error of O(dt²); interpolation has an error of O(h²/dt) for nodes at
            distance h.
        tolerance: largest change of V, relative to the largest V.
        improvements: largest number of policy improvements per grid; `GridValue.converged` tells whether they sufficed.
        start: a solution on a coarser grid.

    Raises:
        InputError: there are not two states, or a setting is out of range.
    """
    low, high = np.asarray(low, float), np.asarray(high, float)
    if low.shape != (2,) or high.shape != (2,) or not (low < high).all():
        raise InputError(f"the rectangle is {low} to {high}; expected two ascending numbers each, for two states")
    if not len(points) or min(points) < 5:
        raise InputError(f"points are {tuple(points)}; expected a number of at least 5 for each grid")
    require_positive(limit=limit, dt=dt, tolerance=tolerance, improvements=improvements)
    circle = tuple(circles(problem).tolist())
    step, discount = flow(problem, dt), math.exp(-problem.discount * dt)

    def policy(x: Array, slope: Array) -> Array:
        return optimal_control(problem, x, slope)[0]

    def on_grid(count: int, coarse: GridValue | None) -> GridValue:
        shape = tuple(count - closed for closed in circle)
        grid = Grid(tuple(low.tolist()), tuple(((high - low) / (count - 1)).tolist()), shape, circle)
        V = jnp.zeros(shape) if coarse is None else interpolated(coarse.grid, coarse.V, grid.nodes)
        return GridValue(grid, *_iterate(step, policy, grid, discount, V, limit, tolerance, improvements))

    solution = on_grid(points[0], start)
    for count in points[1:]:
        solution = on_grid(count, solution)
    return solution


def extrapolated(coarse: GridValue, fine: GridValue, x: Any) -> Array:
    """Returns V at states [..., 2] by Richardson's extrapolation from two grids with errors proportional to h²."""
    ratio = (coarse.grid.steps[0] / fine.grid.steps[0]) ** 2
    of_coarse, of_fine = (interpolated(value.grid, value.V, x) for value in (coarse, fine))
    return of_fine + (of_fine - of_coarse) / (ratio - 1)


def lookahead(problem: ControlProblem, value: GridValue, *, limit: float, dt: float = 0.05) -> Law:
    """Returns the policy of a value on a grid: x [2] -> the listed control u [1] with the lowest cost over dt plus V.

    The cost of this policy is an upper bound of the true value.
    """
    step, listed = flow(problem, dt), jnp.linspace(-limit, limit, 8 * CONTROLS + 1)

    def law(x: Array) -> Array:
        after, cost = jax.vmap(lambda u: step(x, u[None]))(listed)
        totals = cost + math.exp(-problem.discount * dt) * read(value.V, linear(value.grid, after))
        return listed[jnp.argmin(totals)][None]

    return law


@partial(jax.jit, static_argnums=(0, 1, 2))
def _iterate(
    step: Flow,
    policy: Callable[[Array, Array], Array],
    grid: Grid,
    discount: Any,
    V: Array,
    limit: Any,
    tolerance: Any,
    improvements: Any,
) -> tuple[Array, Array, Array, Array]:
    nodes = jnp.asarray(grid.nodes)
    listed = jnp.linspace(-limit, limit, CONTROLS)

    def feet(u: Array) -> tuple[Array, Array]:
        return jax.vmap(jax.vmap(lambda x, u: step(x, u[None])))(nodes, u)

    def total(V: Array, u: Array) -> Array:
        after, cost = feet(u)
        return cost + discount * read(V, linear(grid, after))

    def conjugates(V: Array) -> list[Array]:
        """Returns the controls for the backward, forward and mean slopes."""
        sides = [one_sided_slopes(grid, V, axis) for axis in (0, 1)]
        pairs = [tuple(side[which] for side in sides) for which in (0, 1)]
        pairs.append(tuple((before + after) / 2 for before, after in sides))
        return [jnp.clip(jax.vmap(jax.vmap(policy))(nodes, jnp.stack(pair, axis=-1)), -limit, limit) for pair in pairs]

    def improved(V: Array, u: Array) -> tuple[Array, Array]:
        """Returns the best control and its V at every node; the present control stays unless another is better."""

        def better(best: tuple[Array, Array], other: Array) -> tuple[tuple[Array, Array], None]:
            of_other = total(V, other)
            lower = of_other < best[1]
            return (jnp.where(lower, other, best[0]), jnp.where(lower, of_other, best[1])), None

        shape = (CONTROLS, *grid.shape)
        others = jnp.concatenate([jnp.stack(conjugates(V)), jnp.broadcast_to(listed[:, None, None], shape)])
        return jax.lax.scan(better, (u, total(V, u)), others)[0]

    def followed(V: Array, u: Array, close: Array) -> Array:
        """Returns V of a policy, to within `close`; the iteration is a contraction by the discount."""
        after, cost = feet(u)
        at = linear(grid, after)

        def going(carry: tuple[Array, Array, Array]) -> Array:
            number, _, change = carry
            return (number < SWEEPS) & (change > close)

        def sweep(carry: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
            number, V, _ = carry
            new = cost + discount * read(V, at)
            return number + 1, new, jnp.max(jnp.abs(new - V))

        return jax.lax.while_loop(going, sweep, (jnp.asarray(0), V, jnp.asarray(jnp.inf, V.dtype)))[1]

    def going(carry: tuple[Array, ...]) -> Array:
        number, _, _, change = carry
        return (number < improvements) & (change > tolerance)

    def iterate(carry: tuple[Array, ...]) -> tuple[Array, ...]:
        number, V, u, _ = carry
        u, by_best = improved(V, u)
        size = jnp.max(jnp.abs(by_best))
        change = jnp.max(jnp.abs(by_best - V)) / size
        return number + 1, followed(by_best, u, 0.1 * tolerance * size), u, change

    start = (jnp.asarray(0), V, jnp.zeros_like(V), jnp.asarray(jnp.inf, V.dtype))
    _, V, u, change = jax.lax.while_loop(going, iterate, start)
    ended = jnp.where(change <= tolerance, Ending.CONVERGED, Ending.OUT_OF_ITERATIONS)
    return V, u, change, jnp.where(jnp.isfinite(change) & jnp.isfinite(V).all(), ended, Ending.NOT_FINITE)


def linear(grid: Grid, x: Array) -> tuple[Array, ...]:
    """Returns the stencil of bilinear interpolation at states x [..., 2]; beyond an edge, the edge's value applies.

    It holds rows and columns of nodes [k, ...] with non-negative weights that sum to one.
    """
    return _stencil(grid, x, (0, 1))


def read(values: Array, at: tuple[Array, ...]) -> Array:
    """Interpolates values at the nodes [A, B] to the states of a stencil."""
    rows, columns, row_weights, column_weights = at
    count = len(rows)
    total = jnp.zeros(rows.shape[1:], values.dtype)
    for i in range(count):
        total += row_weights[i] * sum(column_weights[j] * values[rows[i], columns[j]] for j in range(count))
    return total


def interpolated(grid: Grid, values: Array, x: Any) -> Array:
    """Interpolates values at the nodes [A, B], such as V, to states [..., 2] by limited cubics."""
    smooth = read(values, _stencil(grid, jnp.asarray(x), (-1, 0, 1, 2)))
    rows, columns, *_ = linear(grid, jnp.asarray(x))
    corners = jnp.stack([values[row, column] for row in rows for column in columns])
    return jnp.clip(smooth, jnp.min(corners, axis=0), jnp.max(corners, axis=0))


def one_sided_slopes(grid: Grid, values: Array, axis: int) -> tuple[Array, Array]:
    """Returns backward and forward difference quotients along an axis; at an edge both are the one-sided quotient."""
    forward = (jnp.roll(values, -1, axis) - values) / grid.steps[axis]
    backward = jnp.roll(forward, 1, axis)
    if grid.circle[axis]:
        return backward, forward
    place = jnp.arange(values.shape[axis]).reshape([-1 if side == axis else 1 for side in range(values.ndim)])
    first, last = place == 0, place == values.shape[axis] - 1
    return jnp.where(first, forward, backward), jnp.where(last, backward, forward)


def _stencil(grid: Grid, x: Array, offsets: tuple[int, ...]) -> tuple[Array, ...]:
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
    return (*nodes, *weights)
