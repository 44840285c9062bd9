"""Targets of a value along a trajectory: costs with exponential weights, and their slopes; see `fitted`."""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Float

from dln_jax.control.optimal.flow import Flow, flow
from dln_jax.control.optimal.problem import ControlProblem, ValueAndGradient, optimal_control
from dln_jax.control.optimal.worst_case import Disturbance
from dln_jax.types import Scalar


class Targets(NamedTuple):
    """Targets at the states of trajectories."""

    x: Float[Array, "N n"]
    V: Float[Array, " N"]
    slope: Float[Array, "N n"]


def greedy(
    problem: ControlProblem, value: ValueAndGradient, dt: float, disturbance: Disturbance | None = None
) -> Callable[[Array], tuple[Array, Scalar]]:
    """x -> the state after a step under the value's policy, with the worst disturbance if any, and the step's cost."""
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
    """Returns targets at all states of the trajectory from x [n], without the last.

    Args:
        problem: the control problem.
        value: the present value function.
        x: initial state.
        steps: N.
        dt: s.
        memory: of the weights, s.
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
