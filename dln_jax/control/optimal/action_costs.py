"""Convex costs of controls with conjugates that give the optimal control (Lutter, Belousov et al. 2019).

    g*(w) = max_u wᵀu - g(u),   attained at u = grad g*(w)

With the cost to go V, dynamics a + B u and cost q + g, the optimal control is u = grad g*(-Bᵀ dV/dx). A cost that is
infinite beyond limits keeps the control within them. Write your own `ActionCost` as three functions; the documentation
lists table 1 of the paper.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from dln_jax.types import InputError, Scalar, require_positive


class ActionCost(NamedTuple):
    """A cost g, its policy and its conjugate, as functions of one control or one w, both [m]."""

    cost: Callable[[Array], Scalar]
    """g(u); infinite where u is out of range."""
    policy: Callable[[Array], Array]
    """w -> grad g*(w), the u that maximises wᵀu - g(u)."""
    conjugate: Callable[[Array], Scalar]
    """g*(w)."""


def quadratic(R: Any) -> ActionCost:
    """Returns ½ uᵀ R u, for unlimited controls that are linear in w.

    Args:
        R: symmetric, positive definite [m, m], or one number for all controls.

    Raises:
        InputError: R has another form.
    """
    R = np.asarray(R, float)
    if R.ndim not in (0, 2) or (R.ndim and (R.shape[0] != R.shape[1] or not np.allclose(R, R.T))):
        raise InputError(f"R has shape {R.shape}; expected a number, or a symmetric matrix [m, m]")
    if not (np.linalg.eigvalsh(R) if R.ndim else R).min() > 0:
        raise InputError("R is not positive definite; expected a positive cost for every control")
    inverse = np.linalg.inv(R) if R.ndim else np.asarray(1 / R)

    def times(matrix: np.ndarray, vector: Array) -> Array:
        return jnp.asarray(matrix) @ vector if matrix.ndim else float(matrix) * vector

    return ActionCost(
        lambda u: 0.5 * jnp.sum(u * times(R, u)),
        lambda w: times(inverse, w),
        lambda w: 0.5 * jnp.sum(w * times(inverse, w)),
    )


def stretched(cost: ActionCost, a: Any) -> ActionCost:
    """Returns g(u / a), with a separate range for every control: a [m], or one for all."""
    a = np.asarray(a, float)
    _require_scale(a=a.min())
    return ActionCost(lambda u: cost.cost(u / a), lambda w: a * cost.policy(a * w), lambda w: cost.conjugate(a * w))


def centred(cost: ActionCost, u: Any) -> ActionCost:
    """Returns g minus its tangent at u0, which is zero and minimal at the holding control u0, within the same limits.

    Args:
        cost: g, with a slope at u0.
        u: u0 [m].

    Raises:
        InputError: the policy of g does not return u0, for example because u0 is out of range.
    """
    u = jnp.asarray(u, float)
    slope = jax.grad(cost.cost)(u)
    if not bool(jnp.max(jnp.abs(cost.policy(slope) - u)) <= 1e-6 * (1 + jnp.max(jnp.abs(u)))):
        raise InputError(
            f"the limits cannot hold the goal: it takes the control {np.asarray(u).tolist()}, out of the range of the "
            "action cost; give wider limits, or another goal"
        )
    offset = cost.cost(u) - slope @ u
    return ActionCost(
        lambda u: cost.cost(u) - slope @ u - offset,
        lambda w: cost.policy(w + slope),
        lambda w: cost.conjugate(w + slope) + offset,
    )


def limited_atan(limit: float, weight: float) -> ActionCost:
    """Returns -(2 a b/π) log cos(π u/(2 a)), infinite beyond the limit a; the curvature at 0 is π b/(2 a).

    This is the cost of continuous fitted value iteration (Lutter et al. 2021, arXiv:2105.04682). The published program
    uses b = 4 a² R/π, so the curvature is 2 a R (its comment says 2 R).

    Args:
        limit: a, for all controls.
        weight: b.

    Raises:
        InputError: a number is not positive.
    """
    _require_scale(limit=limit, weight=weight)
    a = 2 * limit / np.pi

    def cost(u: Array) -> Scalar:
        angle = u / a
        inside = jnp.clip(angle, -np.pi / 2, np.pi / 2)
        return weight * (a * jnp.sum(jnp.where(jnp.abs(angle) > np.pi / 2, jnp.inf, -jnp.log(jnp.cos(inside)))))

    def conjugate(w: Array) -> Scalar:
        w = w / weight
        return weight * (a * jnp.sum(w * jnp.arctan(w) - 0.5 * jnp.log1p(w**2)))

    return ActionCost(cost, lambda w: a * jnp.arctan(w / weight), conjugate)


def _require_scale(**numbers: Any) -> None:
    require_positive(**{name: float(value) for name, value in numbers.items()})
