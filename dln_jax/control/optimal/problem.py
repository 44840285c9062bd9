"""Discounted optimal control over an infinite horizon, and the Hamilton-Jacobi-Bellman equation of its cost to go.

    V(x) = min_u  integral_0^inf e^(-rho t) [q(x) + g(u)] dt,    dx/dt = a(x) + B(x) u

With g convex the best control is in closed form, and the equation has no minimum in it (Lutter, Belousov et al. 2019):

    u = grad g*(-Bᵀ V_x),    rho V + g*(-Bᵀ V_x) - q - aᵀ V_x = 0

V is a cost, not negative and to be made small. Those who count rewards, such as continuous fitted value iteration
(arXiv:2105.04682), have -q - g, the value -V and u = grad g*(+Bᵀ dvalue/dx).
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from dln_jax.control.optimal.action_costs import ActionCost, centred
from dln_jax.control.state_space import Field, field_of
from dln_jax.mechanics.dynamics import Dynamics, PlainDynamics
from dln_jax.types import InputError, JointKind, Scalar

ValueAndGradient = Callable[[Array], tuple[Scalar, Array]]
"""x [n] -> V and V_x [n]."""


class ControlProblem(NamedTuple):
    """What is to be controlled, at which cost, and where."""

    drift: Callable[[Array], Array]
    """a: x [n] -> [n]."""
    actuation: Callable[[Array], Array]
    """B: x [n] -> [n, m]."""
    state_cost: Callable[[Array], Scalar]
    """q: x -> the cost of a second there, zero at the goal."""
    action_cost: ActionCost
    """g."""
    discount: float
    """rho, 1/s; the cost after a time T counts exp(-rho T)."""
    low: Any
    """Lower corner of the box of states [n] where V is wanted."""
    high: Any
    """Upper corner."""
    joints: tuple[JointKind, ...]
    """Kinds of the first coordinates of x, of which revolute ones are angles."""
    goal: Any
    """x0 [n], at rest without a control."""


class Affine(NamedTuple):
    """dx/dt = a(x) + B(x) u."""

    drift: Callable[[Array], Array]
    actuation: Callable[[Array], Array]


def from_plant(plant: Dynamics | PlainDynamics, actuation: Any = None) -> Affine:
    """a and B of a mechanical system, on x = (q, qd), whose accelerations are affine in the forces.

    Args:
        plant: such as `mechanics.equations.dynamics` gives.
        actuation: matrix [d, m] in tau = actuation u; by default each coordinate has its own motor.
    """
    return from_field(field_of(plant, actuation), None if actuation is None else np.shape(actuation)[1])


def from_field(field: Field, controls: int | None = None) -> Affine:
    """a and B of a field (x, u) -> dx/dt that is affine in its controls.

    Args:
        field: of the plant.
        controls: m; by default half as many as states.
    """

    def rest(x: Array) -> Array:
        return jnp.zeros(len(x) // 2 if controls is None else controls, x.dtype)

    return Affine(
        lambda x: field(x, rest(x)),
        # Affine: the derivative at one control is that at all.
        lambda x: jax.jacfwd(lambda u: field(x, u))(rest(x)),
    )


def rates(problem: ControlProblem) -> Field:
    """The field (x, u) -> a + B u of a problem."""
    return lambda x, u: problem.drift(x) + problem.actuation(x) @ u


def optimal_control(problem: ControlProblem, x: Array, slope: Array) -> Array:
    """u = grad g*(-Bᵀ V_x) [m]."""
    return problem.action_cost.policy(-problem.actuation(x).T @ slope)


def hjb_residual(problem: ControlProblem, x: Array, value: Scalar, slope: Array) -> Scalar:
    """rho V + g*(-Bᵀ V_x) - q - aᵀ V_x, the cost of a second by which V fails the equation at x."""
    gain = problem.action_cost.conjugate(-problem.actuation(x).T @ slope)
    return problem.discount * value + gain - problem.state_cost(x) - problem.drift(x) @ slope


def checked(problem: ControlProblem, *, tolerance: float = 1e-6) -> ControlProblem:
    """The problem, with its box and goal as arrays, if it is one.

    Args:
        problem: as given.
        tolerance: of |dx/dt| at the goal with the control that costs least, and of its cost.

    Raises:
        InputError: shapes that do not agree, an empty box, a negative discount, or a goal that is no equilibrium or
            costs something.
    """
    low, high, goal = (np.asarray(each, float) for each in (problem.low, problem.high, problem.goal))
    if goal.ndim != 1 or low.shape != goal.shape or high.shape != goal.shape:
        raise InputError(f"low, high and goal have shapes {low.shape}, {high.shape}, {goal.shape}; expected [n] each")
    if not (np.isfinite(low) & np.isfinite(high) & (low < high)).all():
        raise InputError(f"the box is from {low.tolist()} to {high.tolist()}; expected low below high, both finite")
    if not ((low <= goal) & (goal <= high)).all():
        raise InputError(f"the goal {goal.tolist()} is outside the box; expected low <= goal <= high")
    if len(problem.joints) > len(goal):
        raise InputError(f"{len(problem.joints)} joints for {len(goal)} states; expected the kinds of the first states")
    if not problem.discount >= 0:
        raise InputError(f"discount is {problem.discount}; expected a rate in 1/s, 0 or more")

    @jax.jit  # compiled once, for many small programs take longer
    def at_rest(x: Array) -> tuple[Array, Array]:
        u = optimal_control(problem, x, jnp.zeros_like(x))
        return jnp.max(jnp.abs(rates(problem)(x, u))), problem.state_cost(x) + problem.action_cost.cost(u)

    moving, cost = map(float, at_rest(jnp.asarray(goal)))
    if not moving <= tolerance:
        raise InputError(
            f"the goal is no equilibrium: dx/dt is {moving:.3g} there with the cheapest control, above {tolerance:g}; "
            "give a state at rest, or centre the action cost at the control that holds it"
        )
    if not abs(cost) <= tolerance:
        raise InputError(f"a second at the goal costs {cost:.3g}; expected none, as V is zero there")
    return problem._replace(low=low, high=high, goal=goal)


def at_goal(problem: ControlProblem, goal: Any, *, tolerance: float = 1e-6) -> ControlProblem:
    """The problem of another goal: the state cost moves there, and controls cost what they differ from the one that
    holds it.

    Args:
        problem: whose goal costs nothing.
        goal: state [n].
        tolerance: of what is left of dx/dt.

    Raises:
        InputError: no control holds the goal, or none within the limits of the action cost.
    """
    goal, before = jnp.asarray(goal, float), jnp.asarray(problem.goal, float)
    if goal.shape != before.shape:
        raise InputError(f"the goal has shape {goal.shape}; expected {before.shape}, a state")
    drift, B = jax.jit(lambda x: (problem.drift(x), problem.actuation(x)))(goal)
    u = jnp.linalg.lstsq(B, -drift)[0]
    left = float(jnp.max(jnp.abs(drift + B @ u)))
    if not left <= tolerance:
        raise InputError(f"the goal is no equilibrium: no control makes dx/dt less than {left:.3g} there; give another")
    cost = problem.state_cost
    return checked(
        problem._replace(
            state_cost=lambda x: cost(x - (goal - before)),
            action_cost=centred(problem.action_cost, u),
            goal=np.asarray(goal),
        )
    )


def features(problem: ControlProblem, x: Array) -> Float[Array, " k"]:
    """z(x) - z(goal) [k]: sines, then cosines of angles, which close the circle, and the other states in box units."""
    circular = np.zeros(len(problem.goal), bool)
    circular[: len(problem.joints)] = np.array(problem.joints) == "revolute"
    half = (np.asarray(problem.high, float) - np.asarray(problem.low, float)) / 2
    goal = jnp.asarray(problem.goal, x.dtype)
    straight = ((x - goal) / jnp.asarray(half, x.dtype))[~circular]
    angle, aim = x[circular], goal[circular]
    return jnp.concatenate([jnp.sin(angle) - jnp.sin(aim), jnp.cos(angle) - jnp.cos(aim), straight])
