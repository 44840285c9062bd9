"""Optimal trajectories with limited controls, by iterative linear-quadratic regulators, and their use as MPC.

    min  sum_k l(x_k, u_k) + l_N(x_N),   x_{k+1} = f(x_k, u_k),   lower <= u_k <= upper

An iteration expands f to first and the costs to second order about the plan (Gauss-Newton: Li and Todorov 2004). It
solves for u_k = ū_k + k_k + K_k (x_k - x̄_k) backwards, with a small quadratic program for the limits in every step
(Tassa, Mansard and Todorov 2014), and takes the best of several step lengths at once. The damping of the controls'
Hessian is raised if no step is better, and lowered otherwise. Everything is traceable: a plan is a tree of arrays.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Bool, Float, Int

from dln_jax.control.state_space import where_finite
from dln_jax.solvers.elimination import solve
from dln_jax.solvers.ending import Ending
from dln_jax.types import InputError, Scalar, require_positive

STEP_LENGTHS = 0.5 ** np.arange(10)
MIN_DAMPING, MAX_DAMPING, FIRST_DAMPING = 1e-9, 1e9, 1e-3
"""Damping of the controls' Hessian, relative to the mean of its diagonal."""
PROJECTED_STEPS = 8
"""Newton iterations of the quadratic program of a step."""


class TrajectoryProblem(NamedTuple):
    """Dynamics, costs and limits of a trajectory."""

    step: Callable[[Array, Array], Array]
    """(x [n], u [m]) -> x' [n], for example of an integrator."""
    cost: Callable[[Array, Array], Scalar]
    """(x, u) -> cost of one step."""
    final_cost: Callable[[Array], Scalar]
    """x -> cost of the last state."""
    lower: Any = -jnp.inf
    """Lower limits of the controls, [m] or one for all."""
    upper: Any = jnp.inf
    lower_x: Any = -jnp.inf
    """Lower limits of the states x_1 to x_N, [n] or one for all; hard, like those of the controls."""
    upper_x: Any = jnp.inf
    path: Callable[[Array, Array], Array] | None = None
    """(x, u) -> [p], not above zero at every step, such as limits of a torque that depends on the state."""
    states: Callable[[Array], Array] | None = None
    """x -> [r], not above zero at x_1 to x_N, such as distances to obstacles with their sign reversed."""
    end_below: Callable[[Array], Array] | None = None
    """x_N -> [e], not above zero."""
    end: Callable[[Array], Array] | None = None
    """x_N -> [q], zero; always hard."""
    soft: tuple[float, float] | None = (1e3, 1e3)
    """Weights (w_1, w_2) of w_1 t + w_2 t² / 2 for the excess t of `path`, `states` and `end_below`; None: hard.

    The excess is zero where constraints can be met at a price per unit below w_1.
    """
    free: Any = None
    """Mask [n] of the components of the first state that are unknowns, such as a duration; by default none."""


class Plan(NamedTuple):
    """Controls, states and gains of N steps from a state."""

    u: Float[Array, "N m"]
    x: Float[Array, "N+1 n"]
    K: Float[Array, "N m n"]
    """Gains; at a state x near the plan the control is u_k + K_k (x - x_k)."""
    cost: Float[Array, ""]
    damping: Float[Array, ""]
    better: Bool[Array, ""]
    """Whether the last iteration found a lower cost."""
    ending: Int[Array, ""]
    """An `Ending`: the reason why the optimisation ended, undecided after a single iteration."""

    @property
    def converged(self) -> Bool[Array, ""]:
        """Whether the optimisation reached its tolerance; `solvers.ending.reason(plan.ending)` says why not."""
        return self.ending == Ending.CONVERGED


def first_plan(problem: TrajectoryProblem, x: Any, u: Any) -> Plan:
    """Returns the plan of controls [N, m] from a state [n]; raises `InputError` for other shapes."""
    x, u = jnp.asarray(x, float), jnp.asarray(u, float)
    if x.ndim != 1 or u.ndim != 2 or not len(u):
        raise InputError(f"x has shape {x.shape}, u {u.shape}; expected a state [n] and controls [N, m]")
    # Without gains, the states about which the controls are planned do not matter.
    about, K = jnp.tile(x, (len(u) + 1, 1)), jnp.zeros((*u.shape, x.shape[0]), x.dtype)
    damping = jnp.asarray(FIRST_DAMPING, x.dtype)
    plan = Plan(u, about, K, jnp.zeros((), x.dtype), damping, jnp.asarray(True), jnp.asarray(Ending.UNDECIDED))
    states, u, cost = _follow(problem, x, plan)
    return plan._replace(u=u, x=states, cost=cost)


def improve(problem: TrajectoryProblem, plan: Plan, *, step_lengths: Any = STEP_LENGTHS) -> Plan:
    """Runs one iteration and takes the best of some step lengths [L]; the cost never rises."""
    k, K = _backward(problem, plan)
    lengths = jnp.asarray(step_lengths, plan.u.dtype)
    x, u, costs = jax.vmap(lambda length: _follow(problem, plan.x[0], plan._replace(u=plan.u + length * k, K=K)))(
        lengths
    )
    # A cost that is not finite never counts as lower.
    best = jnp.argmin(jnp.where(jnp.isfinite(costs), costs, jnp.inf))
    better = costs[best] < plan.cost
    undecided = jnp.asarray(Ending.UNDECIDED)
    less_damping, more_damping = jnp.maximum(plan.damping / 10, MIN_DAMPING), plan.damping * 10
    new = Plan(u[best], x[best], K, costs[best], less_damping, better, undecided)
    kept = plan._replace(K=K, damping=jnp.minimum(more_damping, MAX_DAMPING), better=better, ending=undecided)
    return jax.tree.map(lambda new, old: jnp.where(better, new, old), new, kept)


def mpc(
    problem: TrajectoryProblem, *, iterations: int = 1, step_lengths: Any = STEP_LENGTHS
) -> Callable[[Array, Plan], tuple[Array, Plan]]:
    """Model predictive control: (state, plan) -> (control, plan), with the plan shifted by one step and improved.

    Start with `first_plan` or `optimise`, whose first control is for its first state.

    Args:
        problem: over the horizon.
        iterations: number of iterations per call.
        step_lengths: tried in an iteration [L]; from a good plan few suffice, for less time and memory.
    """
    require_positive(iterations=iterations)

    def act(x: Array, plan: Plan) -> tuple[Array, Plan]:
        # Feedback about the old plan corrects the deviation of the state; controls alone may be unstable.
        states, u, cost = _follow(problem, x, plan)
        now = plan._replace(x=states, u=u, cost=cost)
        for _ in range(iterations):
            now = improve(problem, now, step_lengths=step_lengths)
        moved = jnp.concatenate([now.u[1:], now.u[-1:]])
        gains = jnp.concatenate([now.K[1:], now.K[-1:]])
        last = problem.step(now.x[-1], now.u[-1])
        return where_finite(now.u[0], x), now._replace(u=moved, K=gains, x=jnp.concatenate([now.x[1:], last[None]]))

    return act


def _follow(problem: TrajectoryProblem, x: Array, plan: Plan) -> tuple[Array, Array, Array]:
    """Returns states, controls and cost from a state under the plan and its gains."""

    def step(x: Array, stage: tuple[Array, ...]) -> tuple[Array, tuple[Array, Array, Array]]:
        planned, u, K = stage
        u = jnp.clip(u + K @ (x - planned), problem.lower, problem.upper)
        return problem.step(x, u), (x, u, problem.cost(x, u))

    last, (states, u, costs) = jax.lax.scan(step, x, (plan.x[:-1], plan.u, plan.K))
    return jnp.concatenate([states, last[None]]), u, jnp.sum(costs) + problem.final_cost(last)


def _backward(problem: TrajectoryProblem, plan: Plan) -> tuple[Array, Array]:
    """Returns k [N, m] and K [N, m, n]."""
    n, both = plan.x.shape[1], jnp.concatenate([plan.x[:-1], plan.u], axis=1)

    def of_both(function: Callable[..., Any]) -> Callable[[Array], Any]:
        return lambda xu: function(xu[:n], xu[n:])

    cost, limits = of_both(problem.cost), (problem.lower, problem.upper)
    low, high = (jnp.broadcast_to(jnp.asarray(limit, plan.u.dtype), plan.u.shape) - plan.u for limit in limits)
    slopes = jax.vmap(jax.jacfwd(of_both(problem.step)))(both)
    stages = slopes, jax.vmap(jax.grad(cost))(both), jax.vmap(jax.hessian(cost))(both), low, high
    end = jax.grad(problem.final_cost)(plan.x[-1]), jax.hessian(problem.final_cost)(plan.x[-1])

    def back(value: tuple[Array, Array], stage: tuple[Array, ...]) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
        g, H = value
        slope, gradient, curvature, low, high = stage
        q, Q = gradient + slope.T @ g, curvature + slope.T @ H @ slope
        qx, qu, Qxx, Qux, Quu = q[:n], q[n:], Q[:n, :n], Q[n:, :n], Q[n:, n:]
        size = jnp.mean(jnp.abs(jnp.diagonal(Quu)))
        k, K = _limited_quadratic(Quu + plan.damping * size * jnp.eye(len(qu)), qu, Qux, low, high)
        g = qx + K.T @ Quu @ k + K.T @ qu + Qux.T @ k
        H = Qxx + K.T @ Quu @ K + K.T @ Qux + Qux.T @ K
        return (g, (H + H.T) / 2), (k, K)

    _, (k, K) = jax.lax.scan(back, end, stages, reverse=True)
    return k, K


def _limited_quadratic(Q: Array, q: Array, cross: Array, low: Array, high: Array) -> tuple[Array, Array]:
    """Minimises ½ kᵀ Q k + qᵀ k within limits by projected Newton steps; returns k, and gains of the free controls."""

    def pinned(k: Array) -> Array:
        slope = Q @ k + q
        return ((k <= low) & (slope > 0)) | ((k >= high) & (slope < 0))

    def free_part(fixed: Array) -> Array:
        free = ~fixed
        return jnp.where(free[:, None] & free, Q, jnp.eye(len(q), dtype=Q.dtype))

    def newton(k: Array, _: Any) -> tuple[Array, None]:
        fixed = pinned(k)
        change = solve(free_part(fixed), jnp.where(fixed, 0.0, Q @ k + q))
        return jnp.clip(k - change, low, high), None

    k, _ = jax.lax.scan(newton, jnp.clip(jnp.zeros_like(q), low, high), length=1 if len(q) == 1 else PROJECTED_STEPS)
    fixed = pinned(k)
    return k, -solve(free_part(fixed), jnp.where(fixed[:, None], 0.0, cross))
