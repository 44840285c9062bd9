"""Plans within the limits of a robot, plans of free duration, and the constraint that a plan violates most."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from dln_jax.control.trajectories import Plan, TrajectoryProblem, knots_of
from dln_jax.data.robots import Robot
from dln_jax.types import InputError, Scalar, require_positive


def with_limits_of(problem: TrajectoryProblem, robot: Robot) -> TrajectoryProblem:
    """Returns the problem with the limits of a robot's file, for x = (q, qd) and a motor per joint."""
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
    """Returns a problem whose steps share an unknown duration dt: an additional last state, free at the start.

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
    """Returns a sentence that names the constraint that a plan violates most, and by how much.

    Args:
        problem: the solved problem.
        plan: result of `optimise`, or `solution.plan` of `shoot`.
        tolerance: violations up to this count as none.
    """

    knots, last = knots_of(problem)

    def excesses(x: Array, u: Array) -> dict[str, Array]:
        def at_knots(function: Callable[..., Array]) -> Array:
            return jnp.concatenate([jax.vmap(function)(x[:-1], *knots), function(x[-1], *last)[None]])

        rows = {
            "the lower limit of control {i} at step {k}": problem.lower - u,
            "the upper limit of control {i} at step {k}": u - problem.upper,
            "the lower limit of state {i} at knot {k}": (problem.lower_x - x).at[0].set(-jnp.inf),
            "the upper limit of state {i} at knot {k}": (x - problem.upper_x).at[0].set(-jnp.inf),
            "the dynamics of state {i} at step {k}": jnp.abs(jax.vmap(problem.step)(x[:-1], u, *knots) - x[1:]),
        }
        optional: list[tuple[str, Any, Callable[[Any], Array]]] = [
            ("path constraint {i} at step {k}", problem.path, lambda path: jax.vmap(path)(x[:-1], u, *knots)),
            ("constraint {i} on the states at knot {k}", problem.states,
             lambda states: at_knots(states).at[0].set(-jnp.inf)),
            ("inequality {i} of the end", problem.end_below, lambda below: below(x[-1], *last)[None]),
            ("equation {i} of the end", problem.end, lambda end: jnp.abs(end(x[-1], *last))[None]),
        ]  # fmt: skip
        return rows | {name: rows_of(function) for name, function, rows_of in optional if function is not None}

    every = {name: np.asarray(rows) for name, rows in jax.jit(excesses)(plan.x, plan.u).items()}
    if not all(np.isfinite(array).all() for array in (plan.x, plan.u)):
        return "the plan is not finite"
    name = max(every, key=lambda name: np.max(every[name], initial=-np.inf))
    k, i = np.unravel_index(int(np.argmax(every[name])), every[name].shape)
    excess = float(every[name][k, i])
    if excess <= tolerance:
        return f"all constraints hold within {tolerance:g}"
    return f"{name.format(i=i, k=k)} is violated by {excess:.3g}"
