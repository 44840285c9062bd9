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

from dln_jax.solvers.elements.assembly import Pattern, entries, gradient, pattern, value_and_gradient
from dln_jax.solvers.elements.energies import Blocks, ElementEnergy, element_hessians, project
from dln_jax.solvers.elements.line_search import Evaluated, line_search
from dln_jax.solvers.elements.linear_solvers import LinearSolver, LinearSolverFactory
from dln_jax.solvers.elements.selection import by_size
from dln_jax.solvers.newton import SolverInfo
from dln_jax.types import InputError, require_positive

# Gradients and energies below this many units of rounding are indistinguishable from zero.
_ROUNDING_UNITS = 16
# Shifts of the projected Hessian's diagonal, relative to the largest diagonal entry of an element, tried in turn:
# projected elements alone may add up to a singular matrix. They change the search's directions and not the minimum.
_SHIFTS = (1e-6, 1e-3, 1.0)


class _Sum(NamedTuple):
    """The sum that is minimised, and the solver of its linear systems."""

    energies: tuple[ElementEnergy, ...]
    at: Pattern
    solver: LinearSolver


class _MinimumIterate(NamedTuple):
    point: Evaluated
    floor: Blocks
    unclear: Float[Array, ""]
    iterations: Int[Array, ""]
    stuck: Bool[Array, ""]


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
            `sparse`, `matrix_free`.
        at: the energies' pattern, if already computed.
        definite: also report `SolverInfo.definite`, at the cost of another Hessian, factorisation and accurate solve.

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
    total = _Sum(energies, at, linear_solver(energies, at))
    scale = jnp.broadcast_to(jnp.asarray(scale, x0.dtype), x0.shape[:1])[:, None]

    @jax.custom_jvp
    def minimum(x0: Blocks, data: Any, scale: Array) -> tuple[Blocks, SolverInfo]:
        x, info = _newton(total, x0, data, scale, tolerance, iterations)
        if not definite:
            return x, info
        # For a matrix that is not positive definite, the factor and its solutions are not finite.
        solved = total.solver.solve(_factor(total, x, data), jnp.ones_like(x))
        return x, info._replace(definite=jnp.isfinite(solved).all())

    def derivative(primals: tuple[Any, ...], tangents: tuple[Any, ...]) -> tuple[Any, Any]:
        x, info = minimum(*primals)
        x_dot = _implicit_derivative(total, x, primals[1], *tangents[:2])
        x_dot = x_dot * jnp.where(info.converged, 1.0, jnp.nan).astype(x.dtype)
        return (x, info), (x_dot, jax.tree.map(no_tangent, info))

    minimum.defjvp(derivative, symbolic_zeros=True)
    return minimum(x0, tuple(data), scale)


def is_constant(tangent: Any) -> bool:
    """Whether a tangent of a rule with symbolic zeros is known to be zero."""
    return isinstance(tangent, SymbolicZero) or getattr(tangent, "dtype", None) == jax.dtypes.float0


def no_tangent(leaf: Array) -> Any:
    """Returns the zero tangent of a value."""
    floating = jnp.issubdtype(leaf.dtype, jnp.floating)
    return jnp.zeros_like(leaf) if floating else np.zeros(leaf.shape, jax.dtypes.float0)


def _implicit_derivative(total: _Sum, x: Blocks, data: Any, x0_dot: Any, data_dot: Any) -> Blocks:
    energies, at, solver = total
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
            return gradient(energies, at, x, structure.unflatten(all_leaves))

        def product(v: Blocks) -> Blocks:
            masked = jnp.where(at.free, v, 0)
            curved = jax.jvp(lambda x: gradient(energies, at, x, data), (x,), (masked,))[1]
            return jnp.where(at.free, curved, v)

        varied = [leaves[i] for i in varying]
        if moving:
            _, right = jax.jvp(gradient_of, (x, varied), (fixed_dot, varied_dots))
        else:
            _, right = jax.jvp(lambda variables: gradient_of(x, variables), (varied,), (varied_dots,))
        # The solve is differentiated by its product, so that the factor needs no derivatives of its own.
        factor = _factor(total, *jax.lax.stop_gradient((x, data)))
        return jax.lax.custom_linear_solve(product, -right, lambda _, b: solver.solve(factor, b), symmetric=True)

    fixed_dot = jnp.where(at.free, 0, x0_dot) if moving else None
    solution = response(x, leaves, [dots[i] for i in varying], fixed_dot)
    return solution if fixed_dot is None else solution + fixed_dot


def _factor(total: _Sum, x: Blocks, data: Any) -> Any:
    hessians = element_hessians(total.energies, x, data)
    return total.solver.factorise(hessians, entries(total.at, hessians))


def _newton(
    total: _Sum, x0: Blocks, data: Any, scale: Array, tolerance: float, iterations: int
) -> tuple[Blocks, SolverInfo]:
    energies, at, _ = total
    rounding = _ROUNDING_UNITS * jnp.finfo(x0.dtype).eps

    def evaluate(x: Blocks) -> tuple[Array, Blocks]:
        return value_and_gradient(energies, at, x, data)

    def within(state: _MinimumIterate) -> Array:
        return (jnp.abs(state.point.gradient) <= jnp.maximum(tolerance * scale, state.floor)).all()

    def running(state: _MinimumIterate) -> Array:
        return ~within(state) & ~state.stuck & (state.iterations < iterations)

    def iterate(state: _MinimumIterate) -> _MinimumIterate:
        x, energy, gradient = state.point
        hessians = element_hessians(energies, x, data)
        values = entries(at, hessians)
        direction = _descent_direction(total, hessians, values, gradient)
        slope = jnp.vdot(direction, gradient)
        # Terms that cancel in a row of the gradient are of the size of |H| |x|.
        diagonal = jnp.take(jnp.abs(values), at.diagonal, mode="fill", fill_value=0).reshape(x.shape)
        extent = jnp.max(jnp.abs(x), initial=0)
        floor = rounding * diagonal * extent
        unclear = rounding * jnp.abs(energy) + floor.sum() * extent
        point, accepted = line_search(evaluate, state.point, direction, slope, unclear, scale)
        return _MinimumIterate(point, floor, unclear, state.iterations + 1, ~accepted)

    first = Evaluated(x0, *evaluate(x0))
    start = _MinimumIterate(
        first, jnp.zeros_like(x0), rounding * jnp.abs(first.energy), jnp.asarray(0), jnp.asarray(False)
    )
    last = jax.lax.while_loop(running, iterate, start)
    x, energy, slope = last.point
    residual = jnp.max(jnp.abs(slope) / scale, initial=0)
    return x, SolverInfo(residual, last.iterations, within(last) & jnp.isfinite(energy), None, last.unclear)


def _descent_direction(total: _Sum, hessians: Sequence[Array], values: Array, gradient: Blocks) -> Blocks:
    _, at, solver = total
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
        direction = solver.search(solver.factorise(system, assembled), -gradient)
        descends = jnp.isfinite(direction).all() & (jnp.vdot(direction, gradient) <= 0)
        return direction, descends, attempts + 1

    start = (jnp.zeros_like(gradient), jnp.asarray(False), jnp.asarray(0))
    direction, descends, _ = jax.lax.while_loop(failing, attempt, start)
    return jnp.where(descends, direction, -gradient)
