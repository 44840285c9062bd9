"""Mechanical systems in state space, x = (q, qd): field, steps, linearisation, and errors of angles.

A control law returns NaN for a non-finite state (`where_finite`), also after limiting (`saturated`).
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Bool, Float

from dln_jax.mechanics.dynamics import Dynamics, InverseForward
from dln_jax.mechanics.integrators import Method, advance, rk4
from dln_jax.types import InputError, JointKind, Vector, require_positive

Field = Callable[[Array, Array], Array]
"""(x [n], u [m]) -> dx/dt [n]."""
Law = Callable[[Array], Array]
"""x [n] -> u [m]."""


class Linearisation(NamedTuple):
    """d(x - x0)/dt = A (x - x0) + B (u - u0) about a point where dx/dt = 0."""

    A: Float[Array, "n n"]
    B: Float[Array, "n m"]
    x: Vector
    u: Vector


def field_of(plant: Dynamics | InverseForward, actuation: Any = None) -> Field:
    """Returns the field of a mechanical system, on x = (q, qd) [2 d] and the controls u [m].

    Args:
        plant: for example from `mechanics.equations.dynamics`.
        actuation: matrix [d, m] in tau = actuation u; by default every coordinate has its own motor.
    """

    def field(x: Array, u: Array) -> Array:
        q, qd = jnp.split(x, 2)
        tau = u if actuation is None else jnp.asarray(actuation) @ u
        return jnp.concatenate([qd, plant.forward_dynamics(q, qd, tau)])

    return field


def integrated(field: Field, dt: float, *, method: Method = rk4, substeps: int = 1) -> Callable[[Array, Array], Array]:
    """Returns (x, u) -> x after dt with u held, for a sampled controller or a `TrajectoryProblem`; differentiable.

    A step of an implicit method is NaN if its equations are not solved. It is differentiated by the implicit function
    theorem.

    Args:
        field: (x, u) -> dx/dt.
        dt: s.
        method: one of `mechanics.integrators`, such as `implicit_midpoint` or `radau3` for a stiff plant.
        substeps: steps of the method within dt.

    Raises:
        InputError: dt or the number of substeps is not positive.
    """
    require_positive(dt=dt, substeps=substeps)

    def step(x: Array, u: Array) -> Array:
        return advance(method(lambda t, state: field(state, u)), 0.0, x, dt, substeps=substeps)

    return step


def linearise(field: Field, x: Any, u: Any, *, tolerance: float = 1e-6) -> Linearisation:
    """Returns the linearisation at an equilibrium, by forward-mode derivatives.

    Args:
        field: (x, u) -> dx/dt.
        x: state [n] at rest.
        u: controls [m] that hold the state.
        tolerance: largest |dx/dt| at (x, u), in the units of the field.

    Raises:
        InputError: (x, u) is not an equilibrium.
    """
    x, u = jnp.asarray(x, float), jnp.asarray(u, float)
    rest = field(x, u)
    if not bool(jnp.max(jnp.abs(rest)) <= tolerance):
        raise InputError(
            f"the goal is not an equilibrium: dx/dt is {float(jnp.max(jnp.abs(rest))):.3g} there, above {tolerance:g}; "
            "give a state at rest and the controls that hold it"
        )
    A, B = jax.jacfwd(field, argnums=(0, 1))(x, u)
    return Linearisation(A, B, x, u)


def holding_controls(plant: Dynamics, q: Any, actuation: Any = None, *, tolerance: float = 1e-6) -> Array:
    """Returns the controls [m] that hold the plant in the posture q.

    Args:
        plant: with gravity.
        q: posture [d].
        actuation: as for `field_of`.
        tolerance: largest remaining torque, N m or N.

    Raises:
        InputError: no controls hold it.
    """
    rest = jnp.zeros_like(jnp.asarray(q, float))
    weight = plant.inverse_dynamics(jnp.asarray(q, float), rest, rest)
    if actuation is None:
        return weight
    B = jnp.asarray(actuation, float)
    u = jnp.linalg.lstsq(B, weight)[0]
    left = float(jnp.max(jnp.abs(B @ u - weight)))
    if not left <= tolerance:
        raise InputError(
            f"no controls hold the posture: {left:.3g} N m or N remains at a coordinate without a motor; "
            "give an equilibrium"
        )
    return u


def where_finite(u: Array, *state: Any) -> Array:
    """Returns the controls [m] for a finite state, and NaN for every motor otherwise, so that the caller can react.

    Otherwise a law of some coordinates would return numbers while other coordinates are NaN.
    """
    finite = jnp.asarray(True)
    for part in state:
        finite &= jnp.isfinite(jnp.asarray(part)).all()
    return jnp.where(finite, u, jnp.nan)


def saturated(u: Any, lower: Any, upper: Any) -> Array:
    """Clips controls to their limits; a non-finite control becomes NaN, so that the caller can react."""
    u = jnp.asarray(u)
    return jnp.where(jnp.isfinite(u), jnp.clip(u, lower, upper), jnp.nan)


def circular(joints: tuple[JointKind, ...], n: int) -> Bool[np.ndarray, " n"]:
    """Returns the mask [n] of the angles on a circle; the first states are these joints."""
    return np.array([number < len(joints) and joints[number] == "revolute" for number in range(n)])


def error(x: Array, goal: Any, joints: tuple[JointKind, ...]) -> Array:
    """Returns x - goal [n], with angles wrapped to the shorter way round."""
    difference = x - jnp.asarray(goal)
    wrapped = jnp.arctan2(jnp.sin(difference), jnp.cos(difference))
    return jnp.where(circular(joints, len(difference)), wrapped, difference)
