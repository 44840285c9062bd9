"""Policy of a value function: u = grad g*(-Bᵀ V_x)."""

import jax.numpy as jnp

from dln_jax.control.balance import Law
from dln_jax.control.optimal.problem import ControlProblem, ValueAndGradient, optimal_control


def hjb_policy(value_and_gradient: ValueAndGradient, problem: ControlProblem) -> Law:
    """x [n] -> u [m], within the limits of the action cost; NaN if the state is not finite.

    Args:
        value_and_gradient: x -> V and V_x, for example of a trained network.
        problem: with B and g.
    """

    def law(x):
        u = optimal_control(problem, x, value_and_gradient(x)[1])
        # A limited control is finite even if a rate is infinite.
        return jnp.where(jnp.isfinite(x).all(), u, jnp.nan)

    return law
