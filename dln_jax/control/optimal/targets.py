"""What a value is fitted to along a trajectory: costs with exponential weights, and their slopes; see `fitted`."""

import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Float

from dln_jax.control.optimal.flow import Flow, flow
from dln_jax.control.optimal.problem import ControlProblem, ValueAndGradient, optimal_control


class Targets(NamedTuple):
    """Of the states of trajectories."""

    x: Float[Array, "N n"]
    V: Float[Array, " N"]
    slope: Float[Array, "N n"]


def targets(
    problem: ControlProblem,
    value: ValueAndGradient,
    x: Array,
    *,
    steps: int,
    dt: float,
    memory: Any,
) -> Targets:
    """Targets at all states of the trajectory from x [n], the last of which is not among them.

    Args:
        problem: what is controlled.
        value: the present one.
        x: the start.
        steps: N.
        dt: s.
        memory: of the weights, s.
    """
    step: Flow = flow(problem, dt, clipped=True)
    share, discount = jnp.exp(-dt / jnp.asarray(memory, x.dtype)), math.exp(-problem.discount * dt)

    def closed(x: Array) -> tuple[Array, Array]:
        return step(x, optimal_control(problem, x, value(x)[1]))

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
