"""Newton's method for sums of element energies, with a line search.

    H p = -g,    x <- x + t p

The search uses the true Hessian. It makes element Hessians positive semi-definite only if the factorisation fails,
first those of the moving elements. Always projecting takes several times as many iterations on badly deformed bodies,
and ten times as many on bodies pressed together. Moving elements also limit the steps.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from dln_jax.solvers.elements.assembly import Pattern, entries, value_and_gradient
from dln_jax.solvers.elements.energies import Blocks, ElementEnergy, element_hessians, project, square
from dln_jax.solvers.elements.linear_solvers import LinearSolver, summed_products
from dln_jax.solvers.elements.moving import (
    Lists,
    MovingEnergy,
    lists_between,
    moving_gradient,
    moving_hessians,
    moving_products,
    overflow,
    project_moving,
)
from dln_jax.solvers.newton import SolverInfo

# Gradients and energies below this many units of rounding are indistinguishable from zero.
_ROUNDING_UNITS = 16
# Shifts of the projected Hessian's diagonal, relative to the largest diagonal entry of an element, tried in turn: even
# projected elements may add up to a singular matrix. They change the search directions, not the minimum.
_SHIFTS = (1e-6, 1e-3, 1.0)
# Sufficient decrease (Armijo) and largest number of halvings of the line search.
_DECREASE = 1e-4
_HALVINGS = 40
# How many times a step is shortened eightfold if its list of elements overflows.
_SHORTENINGS = 6


class Sum(NamedTuple):
    """The sum to be minimised, and the solver of its linear systems."""

    energies: tuple[ElementEnergy, ...]
    at: Pattern
    solver: LinearSolver
    moving: tuple[MovingEnergy, ...] = ()


class Evaluated(NamedTuple):
    """A point with its energy and gradient."""

    x: Blocks
    energy: Float[Array, ""]
    gradient: Blocks


class _MinimumIterate(NamedTuple):
    point: Evaluated
    lists: Lists
    floor: Blocks
    unclear: Float[Array, ""]
    iterations: Int[Array, ""]
    stuck: Bool[Array, ""]
    gap: Blocks | None
    """Distance of fixed unknowns from their target values; `None` without moving elements."""


def descend(
    total: Sum, x0: Blocks, data: Any, scale: Array, tolerance: float, iterations: int, start: Blocks
) -> tuple[Blocks, SolverInfo]:
    """Returns the minimum and the outcome of the search; the arguments are those of `minimise`.

    Args:
        x0: values of the unknowns that are not free.
        data: (data of the static energies, data of the moving ones).
        scale: [n, 1].
        tolerance, iterations: as for `minimise`.
        start: first iterate, where all energies are finite.
    """
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
        of_moving = moving_hessians(moving, x, state.lists, data[1])
        direction, forced = _direction(total, state, hessians, values, of_moving)
        lists, limit = _allowed(total, x, direction, data, state.lists)
        slope = jnp.vdot(direction, gradient)
        # Terms that cancel in a row of the gradient have the magnitude of |H| |x|.
        diagonal = jnp.take(jnp.abs(values), at.diagonal, mode="fill", fill_value=0).reshape(x.shape)
        for elements, of_elements in zip(state.lists, of_moving, strict=True):
            own = jnp.abs(jnp.diagonal(of_elements, axis1=1, axis2=2))
            diagonal = diagonal.at[elements.indices].add(own.reshape(*elements.indices.shape, -1))
        extent = jnp.max(jnp.abs(x), initial=0)
        floor = rounding * diagonal * extent
        unclear = rounding * jnp.abs(energy) + floor.sum() * extent

        def evaluate(x: Blocks) -> tuple[Array, Blocks]:
            return sum_and_gradient(total, x, data, lists)

        point, length = _line_search(evaluate, state.point, direction, slope, unclear, scale, limit, forced)
        gap = None if state.gap is None else (1 - length) * state.gap
        stuck = (length == 0) | overflow(lists)
        return _MinimumIterate(point, lists, floor, unclear, state.iterations + 1, stuck, gap)

    lists = lists_between(moving, start, jnp.zeros_like(start), data[1])
    first = Evaluated(start, *sum_and_gradient(total, start, data, lists))
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
    info = SolverInfo(residual, last.iterations, converged, None, last.unclear)
    return x, info._replace(overflow=overflow(last.lists), lists=(lists, last.lists)) if moving else info


def _direction(
    total: Sum, state: _MinimumIterate, hessians: tuple[Array, ...], values: Array, of_moving: tuple[Array, ...]
) -> tuple[Blocks, Array]:
    """Returns Newton's direction, and whether to take it even if it raises the energy."""
    _, at, solver, moving = total
    gradient = state.point.gradient
    if state.gap is not None:
        # Fixed unknowns move by their gap; the free unknowns respond to the linearised forces.
        response = summed_products(total.energies, at, tuple(map(square, hessians)), state.gap)
        response += moving_products(state.lists, of_moving, state.gap)
        gradient += jnp.where(at.free, response, 0)
    shifts = jnp.asarray((*[0.0] * (2 if moving else 1), *_SHIFTS), gradient.dtype)

    # A loop that usually runs once: factorisation and solve are compiled once, and vmap would always take a branch.
    def failing(state: tuple[Any, ...]) -> Array:
        _, descends, number, *_ = state
        return ~descends & (number < len(shifts))

    def attempt(before: tuple[Any, ...]) -> tuple[Any, ...]:
        _, _, number, hessians, values, of_moving = before

        def project_static(_: Array, before: tuple[tuple[Array, ...], Array]) -> tuple[tuple[Array, ...], Array]:
            hessians = project(before[0], shifts[number])
            return hessians, entries(at, hessians)

        times = (number > (1 if moving else 0)).astype(int)
        hessians, values = jax.lax.fori_loop(0, times, project_static, (hessians, values))
        parts = values
        if moving:
            once = (number == 1).astype(int)
            of_moving = jax.lax.fori_loop(0, once, lambda _, before: tuple(map(project_moving, before)), of_moving)
            parts = (values, state.lists, of_moving)
        direction = solver.search(solver.factorise(hessians, parts), -gradient)
        descends = jnp.isfinite(direction).all() & (jnp.vdot(direction, gradient) <= 0)
        return direction, descends, number + 1, hessians, values, of_moving

    start = -gradient, jnp.asarray(False), jnp.asarray(0), hessians, values, of_moving
    direction, descends, *_ = jax.lax.while_loop(failing, attempt, start)
    direction = jnp.where(descends, direction, -gradient)
    if state.gap is None:
        return direction, jnp.asarray(False)
    return direction + state.gap, (state.gap != 0).any()


def _allowed(total: Sum, x: Blocks, direction: Blocks, data: Any, lists: Lists) -> tuple[Lists, Array]:
    """Returns the elements along the direction, and the largest step that lists and energies allow."""
    one = jnp.ones((), x.dtype)
    if not total.moving:
        return lists, one

    def too_many(state: tuple[Lists, Array, Array]) -> Array:
        lists, _, count = state
        return (count == 0) | (overflow(lists) & (count < _SHORTENINGS))

    def shorten(state: tuple[Lists, Array, Array]) -> tuple[Lists, Array, Array]:
        _, _, count = state
        fraction = (1.0 / 8) ** count.astype(x.dtype)
        return lists_between(total.moving, x, fraction * direction, data[1]), fraction, count + 1

    lists, fraction, _ = jax.lax.while_loop(too_many, shorten, (lists, one, jnp.asarray(0)))
    step = fraction * direction
    fractions = [m.longest(x, step, at, of) for m, at, of in zip(total.moving, lists, data[1], strict=True)]
    # With elements left out, no step is known to be safe.
    return lists, jnp.where(overflow(lists), 0.0, fraction * jnp.min(jnp.stack([one, *fractions])))


def sum_and_gradient(total: Sum, x: Blocks, data: Any, lists: Lists) -> tuple[Array, Blocks]:
    """Returns E(x), and dE/dx with zeros where x is not free."""
    energy, slope = value_and_gradient(total.energies, total.at, x, data[0])
    if not total.moving:
        return energy, slope
    more, moving_slope = moving_gradient(total.moving, x, lists, data[1])
    return energy + more, slope + jnp.where(total.at.free, moving_slope, 0)


def _line_search(
    evaluate: Callable[[Blocks], tuple[Float[Array, ""], Blocks]],
    start: Evaluated,
    direction: Blocks,
    slope: Float[Array, ""],
    unclear: Float[Array, ""],
    scale: Float[Array, "n 1"],
    longest: Float[Array, ""],
    any_change: Bool[Array, ""],
) -> tuple[Evaluated, Float[Array, ""]]:
    """Takes the first of the steps l, l/2, l/4, ... that lowers the energy, or the gradient if rounding hides that.

    Energy changes below `unclear` are rounding errors of cancelling terms. The gradient of a stiff body still improves
    by many digits then. Returns point and step length, or the start and 0 if no step is accepted.

    Args:
        evaluate: x -> energy and gradient.
        start: the point where the search starts.
        direction: a descent direction.
        slope: derivative of the energy along the direction, <= 0.
        unclear: energy changes below it are lost in rounding.
        scale: unit of the gradient's rows.
        longest: the first length l.
        any_change: accept any step to a finite energy.
    """

    def size(gradient: Blocks) -> Array:
        return jnp.max(jnp.abs(gradient) / scale, initial=0)

    before = size(start.gradient)

    def attempt(trial: tuple[Evaluated, Array, Array]) -> tuple[Evaluated, Array, Array]:
        _, length, _ = trial
        x = start.x + length * direction
        energy, gradient = evaluate(x)
        change = energy - start.energy
        lower = change <= _DECREASE * length * slope
        flatter = (jnp.abs(change) <= unclear) & (size(gradient) < before)
        accepted = (lower | flatter | any_change) & jnp.isfinite(energy) & jnp.isfinite(gradient).all()
        return Evaluated(x, energy, gradient), length / 2, accepted

    smallest = 2.0**-_HALVINGS * longest
    last, length, accepted = jax.lax.while_loop(
        lambda trial: ~trial[2] & (trial[1] > smallest), attempt, (start, longest, jnp.asarray(False))
    )
    kept = [jnp.where(accepted, new, old) for new, old in zip(last, start, strict=True)]
    return Evaluated(*kept), jnp.where(accepted, 2 * length, 0)
