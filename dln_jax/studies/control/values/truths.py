"""Costs to go by direct optimisation from single states: what a value is measured against where no grid is fine enough.

Controls are held for steps of a horizon, and after it the cost is that of the linear-quadratic regulator at the goal,
with the discount: A - rho/2 in place of A. Several guesses are improved, and the least cost is kept, which bounds V
from above and is V where one of the guesses leads to the best trajectory.
"""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from dln_jax.control import Problem, lqr, optimise
from dln_jax.control.optimal.flow import circles, flow
from dln_jax.control.optimal.problem import ControlProblem
from dln_jax.types import Scalar


def regulator_value(problem: ControlProblem) -> Callable[[Array], Scalar]:
    """x -> V of the problem's second order at its goal, angles the short way round."""
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
    *,
    limit: float,
    seconds: float = 4.0,
    dt: float = 0.02,
    guesses: Sequence[Callable[[np.ndarray], np.ndarray]] = (),
    iterations: int = 100,
    tolerance: float = 1e-7,
) -> tuple[Float[np.ndarray, "G N"], Float[np.ndarray, "G N K"]]:
    """Costs from states x [N, n], of each guess, and its controls, of problems with one control.

    Args:
        problem: what is controlled.
        x: the starts.
        limit: of the control.
        seconds: horizon.
        dt: s.
        guesses: t [K] -> controls [K]; by default waves of three periods, to either side, and none.
        iterations: of the optimisation, at most.
        tolerance: relative change of the cost at which it ends.
    """
    steps = round(seconds / dt)
    t = dt * np.arange(steps)
    begin = np.stack([guess(t) for guess in guesses or waves(limit)])
    move, discount, tail = flow(problem, dt, substeps=2), np.exp(-problem.discount * dt), regulator_value(problem)

    def step(state: Array, u: Array) -> Array:
        return jnp.append(move(state[:-1], u)[0], state[-1] * discount)

    planned = Problem(
        step,
        lambda state, u: state[-1] * move(state[:-1], u)[1],
        lambda state: state[-1] * tail(state[:-1]),
        -limit,
        limit,
    )

    def best(x: Array, u: Array) -> tuple[Array, Array]:
        plan = optimise(planned, jnp.append(x, 1.0), u[:, None], iterations=iterations, tolerance=tolerance)
        return plan.cost, plan.u[:, 0]

    # One guess after the other: a batch takes as long as its slowest.
    of_all = jax.jit(lambda u: jax.vmap(lambda x: best(x, u))(jnp.asarray(x, float)))
    found = [of_all(u) for u in begin]
    return np.stack([cost for cost, _ in found]), np.stack([u for _, u in found])


def waves(limit: float) -> list[Callable[[np.ndarray], np.ndarray]]:
    """A half of the limit at three periods, fading within a second, to either side."""
    return [
        lambda t, period=period, side=side: side * 0.5 * limit * np.sin(2 * np.pi * t / period) * np.exp(-t)
        for period in (0.5, 0.8, 1.2)
        for side in (-1.0, 1.0)
    ]
