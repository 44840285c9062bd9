"""Minimises sums of element energies by Newton's method, differentiable by the implicit function theorem.

    x* = argmin E(x; theta),    H p = -g,    x <- x + t p                      (Newton with a line search)
    dx* = -H⁻¹ (dg/dtheta) dtheta,    g = dE/dx,    H = d²E/dx²                (implicit function theorem)

The iterations are in `descent`. The derivative is exact at the minimum and does not run through the iterations. It
takes one factorisation and one solve, in forward and reverse mode and to any order. At a point that is not a minimum it
is NaN, never a plausible number.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, Float

from dln_jax.solvers.elements.assembly import Pattern, entries, pattern
from dln_jax.solvers.elements.descent import Sum, descend, sum_and_gradient
from dln_jax.solvers.elements.energies import Blocks, ElementEnergy, element_hessians
from dln_jax.solvers.elements.linear_solvers import LinearSolverFactory, by_size
from dln_jax.solvers.elements.moving import (
    Lists,
    MovingEnergy,
    moving_hessians,
    with_moving,
)
from dln_jax.solvers.newton import SolverInfo
from dln_jax.types import InputError, require_positive


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

    The minimum can be differentiated by `data` and by the fixed entries of x0, not by closed-over arrays.

    Args:
        energies: the terms of the sum, or one function (x [n, b], data) -> scalar of all unknowns.
        x0: start [n, b]; float32 or float64 decides the precision.
        data: for every energy, the data of its elements (leading axis m); for one function, its second argument.
        free: [n, b], True for the unknowns to solve for (default: all); the others keep their value in x0.
        scale: positive unit of the gradient's rows, [n] or a number; with masses the residual is an acceleration.
        tolerance: largest |dE/dx| / scale that counts as a minimum; a gradient at the level of rounding always does.
        iterations: largest number of Newton steps; see `SolverInfo.converged`.
        linear_solver: `by_size`, or one of `solvers.elements.linear_solvers`: `dense`, `block_tridiagonal`,
            `sparse`, `matrix_free`. Moving energies have their own solver.
        at: the energies' pattern, if already computed.
        definite: also report `SolverInfo.definite`, which takes another Hessian, factorisation and accurate solve.
        moving: further energies of elements that change with x; they limit the steps.
        moving_data: the data of these energies.
        start: start [n, b] with finite moving energies, if x0 has none. Fixed unknowns approach their values in x0 as
            far as these energies allow. It has no derivatives.

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
    total = Sum(energies, at, solver, moving)
    scale = jnp.broadcast_to(jnp.asarray(scale, x0.dtype), x0.shape[:1])[:, None]

    @jax.custom_jvp
    def minimum(x0: Blocks, data: Any, scale: Array, start: Blocks) -> tuple[Blocks, SolverInfo]:
        x, info = descend(total, x0, data, scale, tolerance, iterations, start)
        if not definite:
            return x, info
        # If the matrix is not positive definite, the factor and its solutions are not finite.
        solved = total.solver.solve(_factor(total, x, data, _lists_of(info)), jnp.ones_like(x))
        return x, info._replace(definite=jnp.isfinite(solved).all())

    def derivative(primals: tuple[Any, ...], tangents: tuple[Any, ...]) -> tuple[Any, Any]:
        x, info = minimum(*primals)
        x_dot = _implicit_derivative(total, x, primals[1], _lists_of(info), *tangents[:2])
        x_dot = x_dot * jnp.where(info.converged, 1.0, jnp.nan).astype(x.dtype)
        return (x, info), (x_dot, jax.tree.map(no_tangent, info))

    minimum.defjvp(derivative, symbolic_zeros=True)
    return minimum(x0, (tuple(data), tuple(moving_data)), scale, x0 if start is None else start)


def is_constant(tangent: Any) -> bool:
    """Returns whether a tangent is known to be zero, in a rule with symbolic zeros."""
    return isinstance(tangent, SymbolicZero) or getattr(tangent, "dtype", None) == jax.dtypes.float0


def no_tangent(leaf: Array) -> Any:
    """Returns the zero tangent of a value."""
    floating = jnp.issubdtype(leaf.dtype, jnp.floating)
    return jnp.zeros_like(leaf) if floating else np.zeros(leaf.shape, jax.dtypes.float0)


def _lists_of(info: SolverInfo) -> Lists:
    return jax.lax.stop_gradient(info.lists[1])


def _implicit_derivative(total: Sum, x: Blocks, data: Any, lists: Lists, x0_dot: Any, data_dot: Any) -> Blocks:
    at, solver = total.at, total.solver
    # Constant data are left out, because their derivatives would be multiplied by zero.
    leaves, structure = jax.tree.flatten(data)
    dots = jax.tree.leaves(data_dot, is_leaf=is_constant)
    varying = [i for i, dot in enumerate(dots) if not is_constant(dot)]
    moving = not (at.free.all() or is_constant(x0_dot))

    # Reverse mode saves only the arguments: recomputing is faster than reading saved intermediates.
    @functools.partial(jax.checkpoint, prevent_cse=False)
    def response(x: Blocks, leaves: list[Array], varied_dots: list[Array], fixed_dot: Any) -> Blocks:
        data = structure.unflatten(leaves)

        def gradient_of(x: Blocks, variables: list[Array]) -> Blocks:
            replaced = dict(zip(varying, variables, strict=True))
            all_leaves = [replaced.get(i, leaf) for i, leaf in enumerate(leaves)]
            return sum_and_gradient(total, x, structure.unflatten(all_leaves), lists)[1]

        def product(v: Blocks) -> Blocks:
            masked = jnp.where(at.free, v, 0)
            curved = jax.jvp(lambda x: sum_and_gradient(total, x, data, lists)[1], (x,), (masked,))[1]
            return jnp.where(at.free, curved, v)

        varied = [leaves[i] for i in varying]
        if moving:
            _, right = jax.jvp(gradient_of, (x, varied), (fixed_dot, varied_dots))
        else:
            _, right = jax.jvp(lambda variables: gradient_of(x, variables), (varied,), (varied_dots,))
        # The solve is differentiated through its product, so that the factor needs no derivatives.
        factor = _factor(total, *jax.lax.stop_gradient((x, data)), lists)
        return jax.lax.custom_linear_solve(product, -right, lambda _, b: solver.solve(factor, b), symmetric=True)

    fixed_dot = jnp.where(at.free, 0, x0_dot) if moving else None
    solution = response(x, leaves, [dots[i] for i in varying], fixed_dot)
    return solution if fixed_dot is None else solution + fixed_dot


def _factor(total: Sum, x: Blocks, data: Any, lists: Lists) -> Any:
    hessians = element_hessians(total.energies, x, data[0])
    values = entries(total.at, hessians)
    if not total.moving:
        return total.solver.factorise(hessians, values)
    moving = moving_hessians(total.moving, x, lists, data[1])
    return total.solver.factorise(hessians, (values, lists, moving))
