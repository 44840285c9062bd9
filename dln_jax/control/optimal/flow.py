"""Trajectories of a control problem: random starts in its box, steps with held controls, and targets of a value.

    x(t + dt),   integral from 0 to dt of e^(-rho s) (q(x(t + s)) + g(u)) ds

are integrated together by the classical Runge-Kutta method. Targets of a value along a trajectory are costs with
exponential weights, and their slopes; see `fitted`.
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from dln_jax.control.optimal.problem import ControlProblem, ValueAndGradient, circles, optimal_control, rates
from dln_jax.control.optimal.worst_case import Disturbance
from dln_jax.mechanics.integrators import advance, rk4
from dln_jax.types import Scalar, require_positive

Flow = Callable[..., tuple[Array, Scalar]]
"""(x [n], u [m], change of dx/dt [n], none by default) -> the state after a step [n], and its discounted cost."""


class Targets(NamedTuple):
    """Targets at the states of trajectories."""

    x: Float[Array, "N n"]
    V: Float[Array, " N"]
    slope: Float[Array, "N n"]


def limits(problem: ControlProblem) -> tuple[np.ndarray, np.ndarray]:
    """Returns the box, without limits for angles on a circle."""
    angles = circles(problem)
    return np.where(angles, -np.inf, problem.low), np.where(angles, np.inf, problem.high)


def uniform(problem: ControlProblem, key: Array, samples: int) -> Float[Array, "samples n"]:
    """Returns random states, uniform in the box."""
    low, high = jnp.asarray(problem.low, float), jnp.asarray(problem.high, float)
    return jax.random.uniform(key, (samples, len(low)), low.dtype, low, high)


def widened(problem: ControlProblem, factor: float) -> ControlProblem:
    """Returns the problem in a box that is `factor` times as wide."""
    low, high = np.asarray(problem.low), np.asarray(problem.high)
    middle, half = (low + high) / 2, factor * (high - low) / 2
    straight = ~circles(problem)
    return problem._replace(low=np.where(straight, middle - half, low), high=np.where(straight, middle + half, high))


def drawn(problem: ControlProblem, key: Array, count: int) -> Float[Array, "N n"]:
    """Returns random states: half of them uniform in the box, half in boxes shrunk by a uniformly distributed factor.

    Angles on a circle are uniform in both. In a box of several dimensions nearly all uniform states are far from rest,
    where motions rarely are.
    """
    of_box, of_share = jax.random.split(key)
    goal = jnp.asarray(problem.goal, float)
    x = uniform(problem, of_box, count)
    share = jnp.where(jnp.arange(count) % 2 == 0, 1.0, jax.random.uniform(of_share, (count,)))
    return jnp.where(circles(problem), x, goal + share[:, None] * (x - goal))


def flow(problem: ControlProblem, dt: float, *, substeps: int = 1, clipped: bool = False) -> Flow:
    """Returns the step of a problem.

    Args:
        problem: defines plant and costs.
        dt: time for which the controls are held, s.
        substeps: integrator steps.
        clipped: whether states that are not on a circle are clipped to the box, as in published fitted iterations; this
            changes the plant wherever trajectories leave the box.
    """
    require_positive(dt=dt, substeps=substeps)
    field, rho = rates(problem), problem.discount
    low, high = map(jnp.asarray, limits(problem))

    def step(x: Array, u: Array, change: Any = 0.0) -> tuple[Array, Scalar]:
        spent = problem.action_cost.cost(u)

        def rate(t: Array, state: tuple[Array, Array]) -> tuple[Array, Array]:
            x, _ = state
            return field(x, u) + change, jnp.exp(-rho * t) * (problem.state_cost(x) + spent)

        after, cost = advance(rk4(rate), 0.0, (x, jnp.zeros((), x.dtype)), dt, substeps=substeps)
        return (jnp.clip(after, low.astype(x.dtype), high.astype(x.dtype)) if clipped else after), cost

    return step


def greedy(
    problem: ControlProblem, value: ValueAndGradient, dt: float, disturbance: Disturbance | None = None
) -> Callable[[Array], tuple[Array, Scalar]]:
    """Returns x -> state after a step under the value's policy, and the step's cost, under the disturbance if any."""
    step: Flow = flow(problem, dt, clipped=True)

    def closed(x: Array) -> tuple[Array, Scalar]:
        slope = value(x)[1]
        u = optimal_control(problem, x, slope)
        return step(x, u, 0.0 if disturbance is None else disturbance(x, slope, u))

    return closed


def targets(
    problem: ControlProblem,
    value: ValueAndGradient,
    x: Array,
    *,
    steps: int,
    dt: float,
    memory: Any,
    disturbance: Disturbance | None = None,
) -> Targets:
    """Returns targets at all states of the trajectory from x [n] except the last.

    Args:
        problem: the control problem.
        value: the present value function.
        x: initial state.
        steps: N.
        dt: s.
        memory: memory of the weights, s.
        disturbance: worst disturbance, held over a step like the controls.
    """
    closed = greedy(problem, value, dt, disturbance)
    share, discount = jnp.exp(-dt / jnp.asarray(memory, x.dtype)), math.exp(-problem.discount * dt)

    def forward(x: Array, _: Any) -> tuple[Array, Array]:
        return closed(x)[0], x

    last, states = jax.lax.scan(forward, x, length=steps)

    def back(carry: tuple[Array, ...], x: Array) -> tuple[tuple[Array, ...], tuple[Array, Array]]:
        V_next, slope_next, G, p = carry
        (_, cost), pull_back = jax.vjp(closed, x)
        G = cost + discount * ((1 - share) * V_next + share * G)
        (p,) = pull_back((discount * ((1 - share) * slope_next + share * p), jnp.ones_like(cost)))
        return (*value(x), G, p), (G, p)

    V_end, slope_end = value(last)
    _, (G, p) = jax.lax.scan(back, (V_end, slope_end, V_end, slope_end), states, reverse=True)
    return Targets(states, G, p)
