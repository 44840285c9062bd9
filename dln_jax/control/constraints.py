"""The constraints of a trajectory problem: names and order for solvers, checks and verdicts.

The vector c [M] of inequalities c <= 0 starts, for every step, with limits of the controls, path constraints, limits of
the states and constraints on the states. Then come the limits and constraints of the last state and of the end. The
rows h and -h come last; they replace the equations h = 0 of the end when violations are minimised. Limits and
constraints of the first state are masked, because no control changes them.
"""

from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.core import Tracer
from jaxtyping import Bool

from dln_jax.control.trajectories import Plan, TrajectoryProblem, knots_of
from dln_jax.data.robots import Robot
from dln_jax.types import InputError, Scalar, require_positive

ROUNDING = 1e-9
"""Smaller differences, relative or absolute, count as zero."""


class Rows(NamedTuple):
    """Constraints of one kind at a step or at the end."""

    name: str
    """Name, with the placeholders {i} for the component and {k} for the step or knot."""
    values: Callable[..., Array]
    """(x [n], u [m], row of the knot, if any) -> [r]; at the end u is `None`."""
    components: np.ndarray
    """Number of the component that each row limits [r]."""
    present: Array
    """False for infinite limits [r]."""
    kind: Literal["limit", "constraint", "equation"]
    of_state: bool = True
    """True if the rows do not depend on the controls."""


class Kinds(NamedTuple):
    """Masks of the inequalities."""

    present: Bool[Array, " M"]
    """Finite limits and all constraints, except those on the first state."""
    soft: Bool[Array, " M"]
    """Constraints that may have a price."""
    unknowns: Bool[Array, " M"]
    """Limits of the controls and of the free components of the states, such as a duration."""
    ends: Bool[Array, " M"]
    """Rows that replace the equations of the end."""


def rows_of(problem: TrajectoryProblem, n: int, m: int) -> tuple[list[Rows], list[Rows]]:
    """Returns the rows of a step and the rows of the end, for n states and m controls."""
    _, last = knots_of(problem)

    def limit(name: str, sign: int, bound: Any, size: int, of_state: bool) -> Rows:
        # Rows of infinite traced limits are masked.
        traced = isinstance(bound, Tracer)
        index = np.arange(size) if traced else np.flatnonzero(np.broadcast_to(np.isfinite(bound), size))
        chosen = lambda: jnp.broadcast_to(jnp.asarray(bound, float), size)[index]  # noqa: E731

        def values(x: Array, u: Array, *knot: Any) -> Array:
            y, at = (x if of_state else u), chosen()
            return sign * (y[index] - jnp.where(jnp.isfinite(at), at, 0.0))

        return Rows(name, values, index, jnp.isfinite(chosen()), "limit", of_state)

    def own(name: str, function: Any, kind: Any = "constraint", of_state: bool = True, sign: int = 1) -> list[Rows]:
        if function is None:
            return []

        def values(x: Array, u: Array, *knot: Any) -> Array:
            return sign * (function(x, *knot) if of_state else function(x, u, *knot))

        size = jax.eval_shape(values, jnp.zeros(n), jnp.zeros(m), *last).shape[0]
        return [Rows(name, values, np.arange(size), jnp.ones(size, bool), kind, of_state)]

    on_states = [
        limit("the lower limit of state {i} at knot {k}", -1, problem.lower_x, n, True),
        limit("the upper limit of state {i} at knot {k}", 1, problem.upper_x, n, True),
        *own("constraint {i} on the states at knot {k}", problem.states),
    ]
    of_steps = [
        limit("the lower limit of control {i} at step {k}", -1, problem.lower, m, False),
        limit("the upper limit of control {i} at step {k}", 1, problem.upper, m, False),
        *own("path constraint {i} at step {k}", problem.path, of_state=False),
        *on_states,
    ]
    below = own("inequality {i} of the end", problem.end_below)
    equal = [own("equation {i} of the end", problem.end, "equation", sign=sign) for sign in (1, -1)]
    return of_steps, [*on_states, *below, *equal[0], *equal[1]]


def stacked(rows: list[Rows]) -> Callable[..., Array]:
    """Returns the function of all rows in one vector, with the arguments of `Rows.values`."""
    return lambda x, u, *knot: jnp.concatenate([one.values(x, u, *knot) for one in rows])


def kinds_of(problem: TrajectoryProblem, shape: tuple[int, int, int]) -> Kinds:
    """Returns the masks of all rows, for N steps with n states and m controls."""
    steps, n, m = shape
    of_steps, of_end = rows_of(problem, n, m)
    free = jnp.zeros(n, bool) if problem.free is None else jnp.asarray(problem.free, bool)

    def every(mask: Callable[[Rows], Any]) -> Array:
        at_step, at_end = (
            [jnp.broadcast_to(mask(one), one.present.shape) for one in rows] for rows in (of_steps, of_end)
        )
        first = [row & (not one.of_state) for one, row in zip(of_steps, at_step, strict=True)]
        later = jnp.tile(jnp.concatenate(at_step), steps - 1)
        return jnp.concatenate([*first, later, *at_end])

    return Kinds(
        every(lambda one: one.present),
        every(lambda one: one.kind == "constraint"),
        every(lambda one: (one.kind == "limit") & (free[one.components] if one.of_state else True)),
        every(lambda one: one.kind == "equation"),
    )


def with_limits_of(problem: TrajectoryProblem, robot: Robot) -> TrajectoryProblem:
    """Returns the problem with the limits of a robot file, for x = (q, qd) and a motor per joint."""
    speed = np.broadcast_to(np.asarray(robot.velocity_limits, float), len(robot.position_limits))
    (low, high), (weakest, strongest) = robot.position_limits.T, robot.force_limits.T
    return problem._replace(
        lower=weakest, upper=strongest, lower_x=np.append(low, -speed), upper_x=np.append(high, speed)
    )


def free_time(
    step: Callable[[Array, Array, Array], Array],
    cost: Callable[[Array, Array, Array], Scalar],
    final_cost: Callable[[Array], Scalar],
    *,
    states: int,
    shortest: float,
    longest: float,
) -> TrajectoryProblem:
    """Returns a problem with an unknown duration dt of all steps: an additional last state, free at the start.

    The states are (x, dt), also in `final_cost` and in constraints added by `_replace`.

    Args:
        step: (x [n], u [m], dt) -> x' [n].
        cost: (x, u, dt) -> cost of one step; dt alone for the shortest time.
        final_cost: (x, dt) [n+1] -> cost of the last state.
        states: n.
        shortest: shortest step, s.
        longest: longest step, s.

    Raises:
        InputError: a number is not positive, or the shortest step is not below the longest.
    """
    require_positive(states=states, shortest=shortest, longest=longest)
    if not shortest < longest:
        raise InputError(f"the shortest step is {shortest} s, the longest {longest} s; expected shortest < longest")
    unlimited = np.full(states, np.inf)
    return TrajectoryProblem(
        lambda x, u: jnp.append(step(x[:-1], u, x[-1]), x[-1]),
        lambda x, u: cost(x[:-1], u, x[-1]),
        final_cost,
        lower_x=np.append(-unlimited, shortest),
        upper_x=np.append(unlimited, longest),
        free=np.append(np.zeros(states, bool), True),
    )


def worst_violation(problem: TrajectoryProblem, plan: Plan, *, tolerance: float = 1e-6) -> str:
    """Returns a sentence with the most violated constraint of a plan and its violation.

    Args:
        problem: the solved problem.
        plan: `solution.plan` of `shoot`, or a plan of `mpc`.
        tolerance: largest accepted violation.
    """
    if not all(np.isfinite(array).all() for array in (plan.x, plan.u)):
        return "the plan is not finite"
    (steps, m), n, (knots, last) = plan.u.shape, plan.x.shape[1], knots_of(problem)
    of_steps, of_end = rows_of(problem, n, m)
    dynamics = Rows("the dynamics of state {i} at step {k}", problem.step, np.arange(n), jnp.ones(n), "equation")

    @jax.jit
    def excesses(x: Array, u: Array) -> list[Array]:
        at_steps = [jax.vmap(one.values)(x[:-1], u, *knots) for one in of_steps]
        ends = [one.values(x[-1], None, *last) for one in of_end]
        return [
            *(v.at[0].set(jnp.where(one.of_state, -jnp.inf, v[0])) for one, v in zip(of_steps, at_steps, strict=True)),
            *(jnp.full((steps + 1, len(v)), -jnp.inf).at[-1].set(v) for v in ends),
            jnp.abs(jax.vmap(problem.step)(x[:-1], u, *knots) - x[1:]),
        ]

    excess = [np.asarray(values) for values in excesses(plan.x, plan.u)]
    most = [np.max(values, initial=-np.inf) for values in excess]
    worst = int(np.argmax(most))
    if most[worst] <= tolerance:
        return f"all constraints hold within {tolerance:g}"
    one = [*of_steps, *of_end, dynamics][worst]
    k, i = np.unravel_index(int(np.argmax(excess[worst])), excess[worst].shape)
    return f"{one.name.format(i=one.components[i], k=k)} is violated by {most[worst]:.3g}"


def require_start(problem: TrajectoryProblem, x: Any, m: int) -> None:
    """Raises `InputError` if a known start is outside limits or constraints; no control can change it."""
    if isinstance(x, Tracer) or not np.isfinite(x).all():
        return
    x = np.asarray(x, float)
    fixed = np.ones(len(x), bool) if problem.free is None else ~np.asarray(problem.free)
    first = jax.tree.map(lambda rows: rows[0], knots_of(problem)[0])
    for one in rows_of(problem, len(x), m)[0]:
        if not one.of_state or not len(one.components):
            continue
        counted = fixed[one.components] if one.kind == "limit" else fixed.all()
        excess = _known(lambda x, one=one: one.values(x, None, *first), x)
        if excess is None:
            continue
        for i in np.flatnonzero(counted & (excess > 0))[:1]:
            name = one.name.format(i=one.components[i], k=0)
            raise InputError(f"the start violates {name} by {excess[i]:.6g}; choose a start inside")


def require_end(problem: TrajectoryProblem, n: int, m: int) -> None:
    """Raises `InputError` if no state within the limits meets a hard linear constraint of the end."""
    if any(isinstance(limit, Tracer) for limit in (problem.lower_x, problem.upper_x)):
        return
    limits = [np.broadcast_to(np.asarray(limit, float), n) for limit in (problem.lower_x, problem.upper_x)]
    if not np.isfinite(limits).any():
        return
    for one in rows_of(problem, n, m)[1]:
        if one.kind == "equation" or (one.kind == "constraint" and problem.soft is None):
            for i, least in enumerate(_least(problem, one, *limits)):
                if least > ROUNDING:
                    raise InputError(
                        f"{one.name.format(i=i, k='N')} is at least {least:.6g} from zero within the limits of the "
                        "states; widen the limits, or move the end"
                    )


def _least(problem: TrajectoryProblem, rows: Rows, low: np.ndarray, high: np.ndarray) -> list[float]:
    """Returns the least value of each row within limits; -inf if it is unbounded, nonlinear or unknown."""
    _, last = knots_of(problem)

    def values(x: Array) -> Array:
        return rows.values(x, None, *last)

    a, b = np.clip(np.random.default_rng(0).normal(size=(2, len(low))), low, high)
    known = _known(lambda a, b: (values(a), values(b), jax.jacfwd(values)(a)), a, b)
    least = []
    for i, (at, other, slope) in enumerate(zip(*known, strict=True) if known else ()):
        corner = np.where(slope > 0, low, np.where(slope < 0, high, a))
        reached = _known(values, corner) if np.isfinite(corner).all() else None
        linear = reached is not None and np.allclose(
            [other, reached[i]], at + (np.stack([b, corner]) - a) @ slope, rtol=ROUNDING, atol=ROUNDING
        )
        least.append(float(reached[i]) if reached is not None and linear else -np.inf)
    return least


def _known(function: Callable[..., Any], *arguments: Any) -> Any:
    """Returns the value of a function, or `None` if it depends on traced values."""
    with jax.ensure_compile_time_eval():
        value = jax.jit(function)(*arguments)
    return None if any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(value)) else jax.tree.map(np.asarray, value)
