"""Discounted optimal control over an infinite horizon, and the Hamilton-Jacobi-Bellman equation of its cost to go.

    V(x) = min_u  integral_0^inf e^(-rho t) [q(x) + g(u)] dt,    dx/dt = a(x) + B(x) u

For convex g a closed form of the optimal control removes the minimum (Lutter, Belousov et al. 2019):

    u = grad g*(-Bᵀ V_x),    rho V + g*(-Bᵀ V_x) - q - aᵀ V_x = 0

V is a cost: non-negative, and minimised. In formulations with rewards, such as continuous fitted value iteration
(arXiv:2105.04682), the reward is -q - g, the value -V and u = grad g*(+Bᵀ dvalue/dx).
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Bool, Float

from dln_jax.control.optimal.action_costs import ActionCost
from dln_jax.control.state_space import Field, Law, circular, field_of, where_finite
from dln_jax.mechanics.dynamics import Dynamics, InverseForward
from dln_jax.mechanics.integrators import rk4
from dln_jax.types import InputError, JointKind, Scalar, require_positive

Flow = Callable[..., tuple[Array, Scalar]]
"""(x [n], u [m], change of dx/dt [n]; default: none) -> state after a step [n], and the discounted cost of the step."""
Disturbance = Callable[[Array, Array, Array], Array]
"""(x, V_x, u) -> the change of dx/dt [n] due to the worst disturbance."""
ValueAndGradient = Callable[[Array], tuple[Scalar, Array]]
"""x [n] -> V and V_x [n]."""


class ControlProblem(NamedTuple):
    """Dynamics, costs and box of a control problem."""

    drift: Callable[[Array], Array]
    """a: x [n] -> [n]."""
    actuation: Callable[[Array], Array]
    """B: x [n] -> [n, m]."""
    state_cost: Callable[[Array], Scalar]
    """q: x -> cost per second, zero at the goal."""
    action_cost: ActionCost
    """g."""
    discount: float
    """rho, 1/s; a cost at time T has the weight exp(-rho T)."""
    low: Any
    """Lower corner of the box of states [n]; V is fitted inside it."""
    high: Any
    """Upper corner."""
    joints: tuple[JointKind, ...]
    """Kinds of the first coordinates of x; revolute ones are angles."""
    goal: Any
    """x0 [n], at rest without control."""


Affine = tuple[Callable[[Array], Array], Callable[[Array], Array]]
"""a and B of dx/dt = a(x) + B(x) u."""


def from_plant(plant: Dynamics | InverseForward, actuation: Any = None) -> Affine:
    """Returns a and B of a mechanical system on x = (q, qd), with accelerations affine in the forces.

    Args:
        plant: for example from `mechanics.equations.dynamics`.
        actuation: matrix [d, m] in tau = actuation u; by default every coordinate has its own motor.
    """
    return from_field(field_of(plant, actuation), None if actuation is None else np.shape(actuation)[1])


def from_field(field: Field, controls: int | None = None) -> Affine:
    """Returns a and B of a field (x, u) -> dx/dt that is affine in its controls.

    Args:
        field: (x, u) -> dx/dt of the plant.
        controls: m; by default half the number of states.
    """

    def rest(x: Array) -> Array:
        return jnp.zeros(len(x) // 2 if controls is None else controls, x.dtype)

    # The field is affine, so its derivative is the same at all controls.
    return lambda x: field(x, rest(x)), lambda x: jax.jacfwd(lambda u: field(x, u))(rest(x))


def rates(problem: ControlProblem) -> Field:
    """Returns the field (x, u) -> a + B u of a problem."""
    return lambda x, u: problem.drift(x) + problem.actuation(x) @ u


def optimal_control(problem: ControlProblem, x: Array, slope: Array) -> Array:
    """Returns u = grad g*(-Bᵀ V_x) [m]."""
    return problem.action_cost.policy(-problem.actuation(x).T @ slope)


def hjb_residual(problem: ControlProblem, x: Array, value: Scalar, slope: Array) -> Scalar:
    """Returns rho V + g*(-Bᵀ V_x) - q - aᵀ V_x, the residual of the equation at x as a cost per second."""
    gain = problem.action_cost.conjugate(-problem.actuation(x).T @ slope)
    return problem.discount * value + gain - problem.state_cost(x) - problem.drift(x) @ slope


def checked(problem: ControlProblem, *, tolerance: float = 1e-6) -> ControlProblem:
    """Validates a problem and returns it with its box and goal as arrays.

    Args:
        problem: problem to validate.
        tolerance: largest |dx/dt| and largest cost at the goal with the cheapest control.

    Raises:
        InputError: shapes do not agree, the box is empty, the discount is negative, or the goal is outside the box, is
            not an equilibrium or has a cost.
    """
    low, high, goal = (np.asarray(point, float) for point in (problem.low, problem.high, problem.goal))
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

    @jax.jit  # one program compiles faster than many small ones
    def at_rest(x: Array) -> tuple[Array, Array]:
        u = optimal_control(problem, x, jnp.zeros_like(x))
        return jnp.max(jnp.abs(rates(problem)(x, u))), problem.state_cost(x) + problem.action_cost.cost(u)

    moving, cost = map(float, at_rest(jnp.asarray(goal)))
    if not moving <= tolerance:
        raise InputError(
            f"the goal is not an equilibrium: dx/dt is {moving:.3g} there with the cheapest control, above "
            f"{tolerance:g}; give a state at rest, or centre the action cost at the holding control"
        )
    if not abs(cost) <= tolerance:
        raise InputError(f"the goal costs {cost:.3g} per second; expected zero, because V is zero there")
    return problem._replace(low=low, high=high, goal=goal)


def circles(problem: ControlProblem) -> Bool[np.ndarray, " n"]:
    """Returns the mask of the coordinates that are angles on a circle."""
    return circular(problem.joints, len(problem.low))


def limits(problem: ControlProblem) -> tuple[np.ndarray, np.ndarray]:
    """Returns the box, without limits for angles on a circle."""
    angles = circles(problem)
    return np.where(angles, -np.inf, problem.low), np.where(angles, np.inf, problem.high)


def uniform(problem: ControlProblem, key: Array, samples: int) -> Float[Array, "samples n"]:
    """Returns random states, uniform in the box."""
    low, high = jnp.asarray(problem.low, float), jnp.asarray(problem.high, float)
    return jax.random.uniform(key, (samples, len(low)), low.dtype, low, high)


def flow(problem: ControlProblem, dt: float, *, clipped: bool = False) -> Flow:
    """Returns the step of a problem, by the classical Runge-Kutta method with held controls.

        x(t + dt),   integral from 0 to dt of e^(-rho s) (q(x(t + s)) + g(u)) ds

    Args:
        problem: defines plant and costs.
        dt: holding time of the controls, s.
        clipped: clip states that are not on a circle to the box, as in published fitted iterations. This changes the
            plant where trajectories leave the box.
    """
    require_positive(dt=dt)
    field, rho = rates(problem), problem.discount
    low, high = map(jnp.asarray, limits(problem))

    def step(x: Array, u: Array, change: Any = 0.0) -> tuple[Array, Scalar]:
        spent = problem.action_cost.cost(u)

        def rate(t: Array, state: tuple[Array, Array]) -> tuple[Array, Array]:
            x, _ = state
            return field(x, u) + change, jnp.exp(-rho * t) * (problem.state_cost(x) + spent)

        after, cost = rk4(rate)(0.0, (x, jnp.zeros((), x.dtype)), dt)
        return (jnp.clip(after, low.astype(x.dtype), high.astype(x.dtype)) if clipped else after), cost

    return step


def widened(problem: ControlProblem, factor: float) -> ControlProblem:
    """Returns the problem in a box that is `factor` times as wide."""
    low, high = np.asarray(problem.low), np.asarray(problem.high)
    middle, half = (low + high) / 2, factor * (high - low) / 2
    straight = ~circles(problem)
    return problem._replace(low=np.where(straight, middle - half, low), high=np.where(straight, middle + half, high))


def drawn(problem: ControlProblem, key: Array, count: int) -> Float[Array, "N n"]:
    """Returns random states: half of them uniform in the box, half in boxes shrunk by a uniformly distributed factor.

    Angles on a circle are uniform in both. In a box of several dimensions nearly all uniform states are far from rest,
    but motions rarely are.
    """
    of_box, of_share = jax.random.split(key)
    goal = jnp.asarray(problem.goal, float)
    x = uniform(problem, of_box, count)
    share = jnp.where(jnp.arange(count) % 2 == 0, 1.0, jax.random.uniform(of_share, (count,)))
    return jnp.where(circles(problem), x, goal + share[:, None] * (x - goal))


def features(problem: ControlProblem, x: Array) -> Float[Array, " k"]:
    """Returns z(x) - z(goal) [k]: sines, then cosines of angles on a circle, then the other states in box units."""
    angles = circles(problem)
    half = (np.asarray(problem.high, float) - np.asarray(problem.low, float)) / 2
    goal = jnp.asarray(problem.goal, x.dtype)
    straight = ((x - goal) / jnp.asarray(half, x.dtype))[~angles]
    angle, aim = x[angles], goal[angles]
    return jnp.concatenate([jnp.sin(angle) - jnp.sin(aim), jnp.cos(angle) - jnp.cos(aim), straight])


def hjb_policy(value_and_gradient: ValueAndGradient, problem: ControlProblem) -> Law:
    """Returns x [n] -> u [m] within the limits of the action cost; NaN if the state is not finite.

    Args:
        value_and_gradient: x -> V and V_x, for example of a trained network.
        problem: with B and g.
    """
    # A limited control would be finite even at an infinite rate.
    return lambda x: where_finite(optimal_control(problem, x, value_and_gradient(x)[1]), x)


def worst_disturbance(
    plant: Callable[[Array, Array, Array], Array],
    p: Any,
    *,
    state: float = 0.0,
    action: float = 0.0,
    observation: float = 0.0,
    parameters: float = 0.0,
    lower: Any = -jnp.inf,
    upper: Any = jnp.inf,
) -> Disturbance:
    """Returns the worst case of bounded disturbances, in closed form (Lutter et al. 2021, arXiv:2105.12189).

        dx/dt = f(x + xi_o, u + xi_u, p + xi_p) + xi_x

    To first order in V_xᵀ f, every disturbance increases the cost to go as fast as its bound allows:

        xi_x along V_x,   xi_u along Bᵀ V_x,   xi_o along (df/dx)ᵀ V_x,   all of prescribed length,
        xi_p = +- a share of every parameter, by the sign of (df/dp)ᵀ V_x

    A value function trained against them gives robust control.

    Args:
        plant: (x [n], u [m], p [k]) -> dx/dt [n], f.
        p: parameters [k].
        state: bound of |xi_x|, in the units of dx/dt; here and below, zero for no disturbance.
        action: bound of |xi_u|, in the units of u.
        observation: bound of |xi_o|, in the units of x.
        parameters: bound of |xi_p| / |p|.
        lower: bound of p + xi_p [k], for example zero for masses; by default none.
        upper: bound of p + xi_p [k]; by default none.

    Raises:
        InputError: a bound is negative.
    """
    bounds = {"state": state, "action": action, "observation": observation, "parameters": parameters}
    for name, bound in bounds.items():
        if not bound >= 0:
            raise InputError(f"the bound of {name} is {bound}; expected 0 or more")
    p = jnp.asarray(p, float)

    def change(x: Array, slope: Array, u: Array) -> Array:
        rate, pull_back = jax.vjp(plant, x, u, p.astype(x.dtype))
        to_x, to_u, to_p = pull_back(slope)
        worst_p = jnp.clip(p + parameters * jnp.abs(p) * jnp.sign(to_p), jnp.asarray(lower), jnp.asarray(upper))
        moved = plant(x + observation * _unit(to_x), u + action * _unit(to_u), worst_p.astype(x.dtype))
        return moved - rate + state * _unit(slope)

    return change


def _unit(z: Array) -> Array:
    """Returns z / |z|, or zero if z is zero, with finite derivatives."""
    square = jnp.sum(z**2)
    some = square > 0
    return jnp.where(some, z / jnp.sqrt(jnp.where(some, square, 1.0)), 0.0)
