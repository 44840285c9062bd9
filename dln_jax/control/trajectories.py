"""Optimal trajectory problems with constraints, and plans as traceable trees of arrays.

min  sum_k l(x_k, u_k) + l_N(x_N),   x_{k+1} = f(x_k, u_k),   c <= 0,   h(x_N) = 0
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float, Int

from dln_jax.solvers.ending import Ending
from dln_jax.types import InputError, Scalar

FIRST_DAMPING = 1e-3
"""Damping of the controls' Hessian in a new plan, relative to the mean of its diagonal."""


class TrajectoryProblem(NamedTuple):
    """Dynamics, costs and limits of a trajectory."""

    step: Callable[..., Array]
    """(x [n], u [m]) -> x' [n], for example by an integrator."""
    cost: Callable[..., Scalar]
    """(x, u) -> cost of one step."""
    final_cost: Callable[..., Scalar]
    """x -> cost of the last state."""
    lower: Any = -jnp.inf
    """Lower limits of the controls, [m] or one for all."""
    upper: Any = jnp.inf
    lower_x: Any = -jnp.inf
    """Lower limits of the states x_1 to x_N, [n] or one for all; hard, like the limits of the controls."""
    upper_x: Any = jnp.inf
    path: Callable[..., Array] | None = None
    """(x, u) -> [p], at most zero at every step, such as limits of a state-dependent torque."""
    states: Callable[..., Array] | None = None
    """x -> [r], at most zero at x_1 to x_N, such as negative distances to obstacles."""
    end_below: Callable[..., Array] | None = None
    """x_N -> [e], at most zero."""
    end: Callable[..., Array] | None = None
    """x_N -> [q], zero; always hard."""
    soft: tuple[float, float] | None = None
    """Weights (w_1, w_2) of w_1 t + w_2 t² / 2 for the excess t of `path`, `states` and `end_below`; None: hard.

    The excess is zero if the constraints can be met at a price per unit below w_1. Otherwise the plan violates them and
    ends with `Ending.EXCEEDED`.
    """
    free: Any = None
    """Mask [n] of the unknown components of the first state, such as a duration; by default none."""
    knots: Any = None
    """Tree of arrays [N+1, ...] that differ between knots, such as times or a reference.

    All functions then take the row of their knot as last argument: `cost(x, u, knot)`, `states(x, knot)`.
    """


def knots_of(problem: TrajectoryProblem) -> tuple[tuple[Any, ...], tuple[Any, ...]]:
    """Returns the knot arguments of functions at the steps, with an axis [N], and at the end; empty without knots."""
    if problem.knots is None:
        return (), ()
    return (jax.tree.map(lambda rows: rows[:-1], problem.knots),), (jax.tree.map(lambda rows: rows[-1], problem.knots),)


class Plan(NamedTuple):
    """Controls, states and gains of N steps from a state."""

    u: Float[Array, "N m"]
    x: Float[Array, "N+1 n"]
    K: Float[Array, "N m n"]
    """Gains; at a state x near the plan the control is u_k + K_k (x - x_k)."""
    cost: Float[Array, ""]
    damping: Float[Array, ""]
    better: Bool[Array, ""]
    """True if the last iteration found a lower cost."""
    ending: Int[Array, ""]
    """An `Ending`: the reason for the end of the optimisation, undecided after a single iteration."""

    @property
    def converged(self) -> Bool[Array, ""]:
        """True if the optimisation reached its tolerance; otherwise `solvers.ending.reason(plan.ending)` gives the
        reason."""
        return self.ending == Ending.CONVERGED


def first_plan(problem: TrajectoryProblem, x: Any, u: Any) -> Plan:
    """Returns the plan with controls [N, m] from a state [n]; raises `InputError` for other shapes."""
    x, u = jnp.asarray(x, float), jnp.asarray(u, float)
    if x.ndim != 1 or u.ndim != 2 or not len(u):
        raise InputError(f"x has shape {x.shape}, u {u.shape}; expected a state [n] and controls [N, m]")
    # Without gains, the reference states of the plan do not matter.
    about, k = jnp.tile(x, (len(u), 1)), jnp.zeros_like(u)
    u = jnp.clip(u, problem.lower, problem.upper)
    K = jnp.zeros((*u.shape, x.shape[0]), x.dtype)
    states, u = followed(problem, x, (about, u, k, K), lambda u, about: u)
    knots, last = knots_of(problem)
    cost = jnp.sum(jax.vmap(problem.cost)(states[:-1], u, *knots)) + problem.final_cost(states[-1], *last)
    damping = jnp.asarray(FIRST_DAMPING, x.dtype)
    return Plan(u, states, K, cost, damping, jnp.asarray(True), jnp.asarray(Ending.UNDECIDED))


def followed(
    problem: TrajectoryProblem, x: Array, stages: tuple[Array, ...], limited: Callable[[Array, Array], Array]
) -> tuple[Array, Array]:
    """Returns states [N+1, n] and controls [N, m] from a state, under u_k + k_k + K_k (x - x_k) within limits.

    Args:
        problem: defines the steps.
        x: first state [n].
        stages: x_k [N, n], u_k [N, m], k_k [N, m] and K_k [N, m, n].
        limited: (control, u_k) -> control within the limits.
    """
    knots, _ = knots_of(problem)

    def step(x: Array, stage: tuple[Any, ...]) -> tuple[Array, tuple[Array, Array]]:
        (planned, u, k, K), *knot = stage
        u = limited(u + k + K @ (x - planned), u)
        return problem.step(x, u, *knot), (x, u)

    last, (states, u) = jax.lax.scan(step, x, (stages, *knots))
    return jnp.concatenate([states, last[None]]), u
