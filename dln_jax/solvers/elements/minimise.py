"""Minimises sums of element energies by Newton's method, differentiable by the implicit function theorem.

    x* = argmin E(x; theta),    H p = -g,    x <- x + t p                      (Newton with a line search)
    dx* = -H⁻¹ (dg/dtheta) dtheta,    g = dE/dx,    H = d²E/dx²                (implicit function theorem)

Newton's method uses the true Hessian. Only if its factorisation fails are the indefinite element Hessians projected to
positive semi-definite ones (always projecting costs several times the iterations on badly deformed bodies). The
derivative belongs to the minimum and not to the iterations: it takes one factorisation and one solve, in forward and
reverse mode and to any order. At a point that is not a minimum the derivative is NaN, never a plausible number.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, Bool, Float, Int

from dln_jax.solvers.elements.assembly import Pattern, entries, pattern, value_and_gradient
from dln_jax.solvers.elements.energies import Blocks, ElementEnergy, element_hessians, project
from dln_jax.solvers.elements.line_search import Evaluated, line_search
from dln_jax.solvers.elements.linear_solvers import LinearSolver, LinearSolverFactory
from dln_jax.solvers.elements.moving import (
    Lists,
    MovingEnergy,
    add_diagonals,
    lists_between,
    longest_fraction,
    moving_gradient,
    moving_hessians,
    overflow,
    with_moving,
)
from dln_jax.solvers.elements.selection import by_size
from dln_jax.solvers.newton import SolverInfo
from dln_jax.types import InputError, require_positive

# Gradients and energies below this many units of rounding are indistinguishable from zero.
_ROUNDING_UNITS = 16
# Shifts of the projected Hessian's diagonal, relative to the largest diagonal entry of an element, tried in turn:
# projected elements alone may add up to a singular matrix. They change the search's directions and not the minimum.
_SHIFTS = (1e-6, 1e-3, 1.0)
# How often a step whose list of elements overflows is shortened, eightfold.
_SHORTENINGS = 6


class _Sum(NamedTuple):
    """The sum that is minimised, and the solver of its linear systems."""

    energies: tuple[ElementEnergy, ...]
    at: Pattern
    solver: LinearSolver
    moving: tuple[MovingEnergy, ...] = ()


class _MinimumIterate(NamedTuple):
    point: Evaluated
    lists: Lists
    floor: Blocks
    unclear: Float[Array, ""]
    iterations: Int[Array, ""]
    stuck: Bool[Array, ""]
    gap: Blocks | None
    """What fixed unknowns are away from their values, where they approach them; `None` without moving elements."""


def minimise(
    energies: Sequence[ElementEnergy] | Callable[[Blocks, Any], Array],
    x0: Array,
    data: Any = None,
    *,
    free: Any = None,
    scale: Float[Array, " n"] | float = 1.0,
    tolerance: float = 1e-8,
    iterations: int = 100,
    linear_solver: LinearSolverFactory = by_size,
    at: Pattern | None = None,
    definite: bool = False,
    moving: Sequence[MovingEnergy] = (),
    moving_data: Sequence[Any] = (),
    start: Blocks | None = None,
) -> tuple[Blocks, SolverInfo]:
    """Returns the x [n, b] near x0 that minimises the sum of the energies, and the outcome of the search.

    Derivatives are those of the minimum, with respect to `data` and to the entries of x0 that are not free. Arrays that
    an energy closes over are constants.

    Args:
        energies: the terms of the sum, or one function (x [n, b], data) -> scalar of all unknowns.
        x0: start [n, b]; float32 or float64 decides the precision.
        data: for every energy, the data of its elements (leading axis m); for one function, its second argument.
        free: [n, b], which unknowns are solved for (default: all); the others keep their value in x0.
        scale: positive unit of the gradient's rows, [n] or a number; masses make the residual an acceleration.
        tolerance: largest |dE/dx| / scale that counts as a minimum; a gradient of rounding size always does.
        iterations: Newton steps after which the search gives up, which `SolverInfo.converged` reports.
        linear_solver: `by_size`, or one of `solvers.elements.linear_solvers`: `dense`, `block_tridiagonal`,
            `sparse`, `matrix_free`. Moving energies have a solver of their own.
        at: the energies' pattern, if already computed.
        definite: also report `SolverInfo.definite`, at the cost of another Hessian, factorisation and accurate solve.
        moving: further energies, whose elements change with x and which bound the steps.
        moving_data: the data of these energies.
        start: start [n, b] that the moving energies allow, if x0 is not one; its unknowns that are not free approach
            their values in x0 as far as the moving energies allow. It has no derivatives.

    Raises:
        InputError: indices, shapes or settings are invalid.
    """
    require_positive(tolerance=tolerance, iterations=iterations)
    if x0.ndim != 2:
        raise InputError(f"x0 has shape {x0.shape}; expected [n, b], blocks of unknowns")
    if callable(energies):
        energies = (ElementEnergy(energies, np.arange(x0.shape[0])[None]),)
        data = (jax.tree.map(lambda leaf: jnp.asarray(leaf)[None], data),)
    energies = tuple(energies)
    at = pattern(energies, x0.shape[0], x0.shape[1], free) if at is None else at
    moving = tuple(moving)
    solver = with_moving(energies, at) if moving else linear_solver(energies, at)
    total = _Sum(energies, at, solver, moving)
    scale = jnp.broadcast_to(jnp.asarray(scale, x0.dtype), x0.shape[:1])[:, None]

    @jax.custom_jvp
    def minimum(x0: Blocks, data: Any, scale: Array, start: Blocks) -> tuple[Blocks, SolverInfo]:
        x, info = _newton(total, x0, data, scale, tolerance, iterations, start)
        if not definite:
            return x, info
        # For a matrix that is not positive definite, the factor and its solutions are not finite.
        solved = total.solver.solve(_factor(total, x, data, _lists(total, x, data)), jnp.ones_like(x))
        return x, info._replace(definite=jnp.isfinite(solved).all())

    def derivative(primals: tuple[Any, ...], tangents: tuple[Any, ...]) -> tuple[Any, Any]:
        x, info = minimum(*primals)
        x_dot = _implicit_derivative(total, x, primals[1], *tangents[:2])
        x_dot = x_dot * jnp.where(info.converged, 1.0, jnp.nan).astype(x.dtype)
        return (x, info), (x_dot, jax.tree.map(no_tangent, info))

    minimum.defjvp(derivative, symbolic_zeros=True)
    return minimum(x0, (tuple(data), tuple(moving_data)), scale, x0 if start is None else start)


def is_constant(tangent: Any) -> bool:
    """Whether a tangent of a rule with symbolic zeros is known to be zero."""
    return isinstance(tangent, SymbolicZero) or getattr(tangent, "dtype", None) == jax.dtypes.float0


def no_tangent(leaf: Array) -> Any:
    """Returns the zero tangent of a value."""
    floating = jnp.issubdtype(leaf.dtype, jnp.floating)
    return jnp.zeros_like(leaf) if floating else np.zeros(leaf.shape, jax.dtypes.float0)


def _implicit_derivative(total: _Sum, x: Blocks, data: Any, x0_dot: Any, data_dot: Any) -> Blocks:
    at, solver, lists = total.at, total.solver, _lists(total, x, data)
    # Constant data are left out: their derivatives would only be multiplied by zero.
    leaves, structure = jax.tree.flatten(data)
    dots = jax.tree.leaves(data_dot, is_leaf=is_constant)
    varying = [i for i, dot in enumerate(dots) if not is_constant(dot)]
    moving = not (at.free.all() or is_constant(x0_dot))

    # Reverse mode saves only the arguments: recomputing takes less time than reading saved intermediates.
    @functools.partial(jax.checkpoint, prevent_cse=False)
    def response(x: Blocks, leaves: list[Array], varied_dots: list[Array], fixed_dot: Any) -> Blocks:
        data = structure.unflatten(leaves)

        def gradient_of(x: Blocks, variables: list[Array]) -> Blocks:
            replaced = dict(zip(varying, variables, strict=True))
            all_leaves = [replaced.get(i, leaf) for i, leaf in enumerate(leaves)]
            return _value_and_gradient(total, x, structure.unflatten(all_leaves), lists)[1]

        def product(v: Blocks) -> Blocks:
            masked = jnp.where(at.free, v, 0)
            curved = jax.jvp(lambda x: _value_and_gradient(total, x, data, lists)[1], (x,), (masked,))[1]
            return jnp.where(at.free, curved, v)

        varied = [leaves[i] for i in varying]
        if moving:
            _, right = jax.jvp(gradient_of, (x, varied), (fixed_dot, varied_dots))
        else:
            _, right = jax.jvp(lambda variables: gradient_of(x, variables), (varied,), (varied_dots,))
        # The solve is differentiated by its product, so that the factor needs no derivatives of its own.
        factor = _factor(total, *jax.lax.stop_gradient((x, data)), lists)
        return jax.lax.custom_linear_solve(product, -right, lambda _, b: solver.solve(factor, b), symmetric=True)

    fixed_dot = jnp.where(at.free, 0, x0_dot) if moving else None
    solution = response(x, leaves, [dots[i] for i in varying], fixed_dot)
    return solution if fixed_dot is None else solution + fixed_dot


def _lists(total: _Sum, x: Blocks, data: Any) -> Lists:
    return lists_between(total.moving, x, jnp.zeros_like(x), data[1])


def _value_and_gradient(total: _Sum, x: Blocks, data: Any, lists: Lists) -> tuple[Array, Blocks]:
    energy, slope = value_and_gradient(total.energies, total.at, x, data[0])
    if not total.moving:
        return energy, slope
    more, moving_slope = moving_gradient(total.moving, x, lists, data[1])
    return energy + more, slope + jnp.where(total.at.free, moving_slope, 0)


def _factor(total: _Sum, x: Blocks, data: Any, lists: Lists) -> Any:
    hessians = element_hessians(total.energies, x, data[0])
    values = entries(total.at, hessians)
    if not total.moving:
        return total.solver.factorise(hessians, values)
    moving = moving_hessians(total.moving, x, lists, data[1], projected=False)
    return total.solver.factorise(hessians, (values, lists, moving))


def _newton(
    total: _Sum, x0: Blocks, data: Any, scale: Array, tolerance: float, iterations: int, start: Blocks
) -> tuple[Blocks, SolverInfo]:
    at, moving = total.at, total.moving
    rounding = _ROUNDING_UNITS * jnp.finfo(x0.dtype).eps

    def within(state: _MinimumIterate) -> Array:
        small = (jnp.abs(state.point.gradient) <= jnp.maximum(tolerance * scale, state.floor)).all()
        return small if state.gap is None else small & (state.gap == 0).all()

    def running(state: _MinimumIterate) -> Array:
        return ~within(state) & ~state.stuck & (state.iterations < iterations)

    def iterate(state: _MinimumIterate) -> _MinimumIterate:
        x, energy, gradient = state.point
        hessians = element_hessians(total.energies, x, data[0])
        values = entries(at, hessians)
        # Contact forces on curved distances make Hessians indefinite in most steps, so that these are always projected.
        of_moving = moving_hessians(moving, x, state.lists, data[1], projected=True)
        direction, forced = _direction(total, state, hessians, values, of_moving, data)
        lists, direction, limit = _allowed(total, x, direction, data, state.lists)
        slope = jnp.vdot(direction, gradient)
        # Terms that cancel in a row of the gradient are of the size of |H| |x|.
        diagonal = jnp.take(jnp.abs(values), at.diagonal, mode="fill", fill_value=0).reshape(x.shape)
        diagonal = add_diagonals(diagonal, state.lists, of_moving)
        extent = jnp.max(jnp.abs(x), initial=0)
        floor = rounding * diagonal * extent
        unclear = rounding * jnp.abs(energy) + floor.sum() * extent

        def evaluate(x: Blocks) -> tuple[Array, Blocks]:
            return _value_and_gradient(total, x, data, lists)

        point, length = line_search(
            evaluate, state.point, direction, slope, unclear, scale, longest=limit, any_change=forced
        )
        gap = None if state.gap is None else (1 - length) * state.gap
        stuck = (length == 0) | overflow(lists)
        return _MinimumIterate(point, lists, floor, unclear, state.iterations + 1, stuck, gap)

    lists = _lists(total, start, data)
    first = Evaluated(start, *_value_and_gradient(total, start, data, lists))
    begin = _MinimumIterate(
        first,
        lists,
        jnp.zeros_like(x0),
        rounding * jnp.abs(first.energy),
        jnp.asarray(0),
        overflow(lists),
        None if not moving or at.free.all() else jnp.where(at.free, 0, x0 - start),
    )
    last = jax.lax.while_loop(running, iterate, begin)
    x, energy, slope = last.point
    residual = jnp.max(jnp.abs(slope) / scale, initial=0)
    converged = within(last) & jnp.isfinite(energy) & ~overflow(last.lists)
    too_many = overflow(last.lists) if moving else None
    return x, SolverInfo(residual, last.iterations, converged, None, last.unclear, too_many)


def _direction(
    total: _Sum,
    state: _MinimumIterate,
    hessians: Sequence[Array],
    values: Array,
    of_moving: Sequence[Array],
    data: Any,
) -> tuple[Blocks, Array]:
    """Returns Newton's direction, and whether it must be taken although it may raise the energy."""
    x, _, right = state.point
    if state.gap is not None:
        # Fixed unknowns move by their gap; the free ones respond as the linearised forces say.
        gradient = functools.partial(_value_and_gradient, total, data=data, lists=state.lists)
        right += jax.jvp(lambda x: gradient(x)[1], (x,), (state.gap,))[1]
    direction = _descent_direction(total, hessians, values, right, of_moving, state.lists)
    if state.gap is None:
        return direction, jnp.asarray(False)
    return direction + state.gap, (state.gap != 0).any()


def _allowed(total: _Sum, x: Blocks, direction: Blocks, data: Any, lists: Lists) -> tuple[Lists, Blocks, Array]:
    """Returns the elements along the direction, the direction, shortened if they are too many, and its limit."""
    if not total.moving:
        return lists, direction, jnp.ones((), x.dtype)

    def too_many(state: tuple[Lists, Array, Array]) -> Array:
        lists, _, count = state
        return (count == 0) | (overflow(lists) & (count < _SHORTENINGS))

    def shorten(state: tuple[Lists, Array, Array]) -> tuple[Lists, Array, Array]:
        _, _, count = state
        fraction = (1.0 / 8) ** count.astype(x.dtype)
        return lists_between(total.moving, x, fraction * direction, data[1]), fraction, count + 1

    begin = lists, jnp.ones((), x.dtype), jnp.asarray(0)
    lists, fraction, _ = jax.lax.while_loop(too_many, shorten, begin)
    return lists, direction, fraction * longest_fraction(total.moving, x, fraction * direction, lists, data[1])


def _descent_direction(
    total: _Sum,
    hessians: Sequence[Array],
    values: Array,
    gradient: Blocks,
    of_moving: Sequence[Array],
    lists: Lists,
) -> Blocks:
    _, at, solver, moving = total
    shifts = jnp.asarray(_SHIFTS, gradient.dtype)

    def failing(state: tuple[Blocks, Array, Array]) -> Array:
        _, descends, attempts = state
        return ~descends & (attempts <= len(_SHIFTS))

    def attempt(state: tuple[Blocks, Array, Array]) -> tuple[Blocks, Array, Array]:
        attempts = state[2]

        def project_once(system: tuple[tuple[Array, ...], Array, Array]) -> tuple[tuple[Array, ...], Array, Array]:
            projected = project(tuple(hessians), shifts[attempts - 1])
            return projected, entries(at, projected), jnp.asarray(False)

        # Loops in place of branches, because under vmap a branch would always be taken. All attempts share one
        # factorisation in the program, because compiling it takes time.
        first = (tuple(hessians), values, attempts > 0)
        system, assembled, _ = jax.lax.while_loop(lambda system: system[2], project_once, first)
        factor = solver.factorise(system, (assembled, lists, of_moving) if moving else assembled)
        direction = solver.search(factor, -gradient)
        descends = jnp.isfinite(direction).all() & (jnp.vdot(direction, gradient) <= 0)
        return direction, descends, attempts + 1

    start = (jnp.zeros_like(gradient), jnp.asarray(False), jnp.asarray(0))
    direction, descends, _ = jax.lax.while_loop(failing, attempt, start)
    return jnp.where(descends, direction, -gradient)
