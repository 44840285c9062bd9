"""Costs to go by direct optimisation from single states, as a reference where no grid is fine enough.

Controls are constant over the steps of a horizon. After it the cost is that of the linear-quadratic regulator at the
goal with discount: A - rho/2 in place of A. Several guesses are improved and the lowest cost is kept. It bounds V from
above, and equals V if one of the guesses leads to the best trajectory.
"""

import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from dln_jax.control import TrajectoryProblem, lqr, optimise
from dln_jax.control.optimal.flow import flow
from dln_jax.control.optimal.problem import ControlProblem, circles
from dln_jax.types import Scalar


def regulator_value(problem: ControlProblem) -> Callable[[Array], Scalar]:
    """x -> V of the linear-quadratic approximation at the goal, with wrapped angle errors."""
    goal = jnp.asarray(problem.goal)
    B = problem.actuation(goal)
    A = jax.jacfwd(problem.drift)(goal) - 0.5 * problem.discount * jnp.eye(len(goal))
    Q = 0.5 * jax.hessian(problem.state_cost)(goal)
    R = 0.5 * jax.hessian(problem.action_cost.cost)(jnp.zeros(B.shape[1]))
    S, angles = lqr(A, B, Q, R).S, circles(problem)

    def value(x: Array) -> Scalar:
        off = x - goal
        off = jnp.where(angles, off - 2 * jnp.pi * jnp.round(off / (2 * jnp.pi)), off)
        return off @ S @ off

    return value


def direct_values(
    problem: ControlProblem,
    x: Any,
    guesses: Any,
    *,
    limit: float,
    dt: float,
    iterations: int = 60,
    tolerance: float = 1e-7,
) -> Float[np.ndarray, "G N"]:
    """Optimised costs from states x [N, n] by guess, for problems with one control.

    The trapezoidal rule integrates the state's cost; its error, like that of constant controls, is of order dt².

    Args:
        problem: control problem.
        x: initial states.
        guesses: controls [G, N, K] of the horizon's K steps.
        limit: limit of the control.
        dt: length of a step, s.
        iterations: maximum number of iterations.
        tolerance: the optimisation ends at this relative change of the cost.
    """
    move, tail = flow(problem, dt), regulator_value(problem)
    discount, half = math.exp(-problem.discount * dt), math.exp(-problem.discount * dt / 2)

    def step(state: Array, u: Array) -> Array:
        return jnp.append(move(state[:-1], u)[0], state[-1] * discount)

    def cost(state: Array, u: Array) -> Scalar:
        return state[-1] * dt * (problem.state_cost(state[:-1]) + half * problem.action_cost.cost(u))

    def final(state: Array) -> Scalar:
        return state[-1] * (tail(state[:-1]) + 0.5 * dt * problem.state_cost(state[:-1]))

    planned = TrajectoryProblem(step, cost, final, -limit, limit)

    def best(x: Array, u: Array) -> Array:
        plan = optimise(planned, jnp.append(x, 1.0), u[:, None], iterations=iterations, tolerance=tolerance)
        return plan.cost - 0.5 * dt * problem.state_cost(x)

    # One guess after the other: a batch takes as long as its slowest member.
    of_all = jax.jit(jax.vmap(best))
    return np.stack([of_all(jnp.asarray(x, float), jnp.asarray(u, float)) for u in guesses])


def followed(
    problem: ControlProblem, law: Callable[[Array], Array], x: Any, *, dt: float, steps: int
) -> Float[np.ndarray, "N K"]:
    """The controls of a policy with one control along its trajectories from states x [N, n], as guesses."""
    move = flow(problem, dt)

    def step(x: Array, _: Any) -> tuple[Array, Array]:
        u = law(x)
        return move(x, u)[0], u[0]

    return np.asarray(jax.jit(jax.vmap(lambda x: jax.lax.scan(step, x, length=steps)[1]))(jnp.asarray(x, float)))
