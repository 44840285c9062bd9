"""Steps of a control problem: the state after a time with held controls, and the cost of that time.

    x(t + dt),   integral from 0 to dt of e^(-rho s) (q(x(t + s)) + g(u)) ds

by the classical Runge-Kutta method on both at once.
"""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
from jax import Array

from dln_jax.control.optimal.boxes import limits
from dln_jax.control.optimal.problem import ControlProblem, rates
from dln_jax.mechanics.integrators import CLASSICAL, advance, runge_kutta
from dln_jax.types import Scalar, require_positive

Flow = Callable[..., tuple[Array, Scalar]]
"""(x [n], u [m], change of dx/dt [n], none by default) -> the state after a step [n], and its discounted cost."""


def flow(problem: ControlProblem, dt: float, *, substeps: int = 1, clipped: bool = False) -> Flow:
    """Returns the step of a problem.

    Args:
        problem: with plant and costs.
        dt: time for which the controls are held, s.
        substeps: integrator steps.
        clipped: whether states that are not on a circle are clipped to the box, as in published fitted iterations; this
            changes the plant wherever trajectories leave the box.
    """
    require_positive(dt=dt, substeps=substeps)
    field, rho = rates(problem), problem.discount
    low, high = (jnp.asarray(each) for each in limits(problem))

    def step(x: Array, u: Array, change: Any = 0.0) -> tuple[Array, Scalar]:
        spent = problem.action_cost.cost(u)

        def rate(t: Array, state: tuple[Array, Array]) -> tuple[Array, Array]:
            x, _ = state
            return field(x, u) + change, jnp.exp(-rho * t) * (problem.state_cost(x) + spent)

        after, cost = advance(runge_kutta(CLASSICAL, rate), 0.0, (x, jnp.zeros((), x.dtype)), dt, substeps=substeps)
        return (jnp.clip(after, low.astype(x.dtype), high.astype(x.dtype)) if clipped else after), cost

    return step
