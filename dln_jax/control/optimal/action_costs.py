"""Convex costs of controls, whose conjugates give the optimal control in closed form (Lutter, Belousov et al. 2019).

    g*(w) = max_u wᵀu - g(u),   attained at u = grad g*(w)

With the cost to go V, dynamics a + B u and cost q + g, the optimal control is u = grad g*(-Bᵀ dV/dx). A cost that is
infinite beyond limits keeps the control within them. The basic costs are those of the paper's table 1; rules derive
others from them.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.scipy.special import xlogy

from dln_jax.nn.activations import softplus
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
    """Returns ½ uᵀ R u, for unlimited controls, which are linear in w.

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


def _within(lower: float, upper: float, cost: Callable[[Array], Array]) -> Callable[[Array], Scalar]:
    """Returns the sum over controls, infinite if one is out of range; NaN stays NaN."""
    return lambda u: jnp.sum(jnp.where((u < lower) | (u > upper), jnp.inf, cost(jnp.clip(u, lower, upper))))


def _entropy(u: Array) -> Array:
    return xlogy(u, u) + xlogy(1 - u, 1 - u)


logistic = ActionCost(_within(0.0, 1.0, _entropy), softplus.first, lambda w: jnp.sum(softplus.value(w)))
"""u log u + (1 - u) log(1 - u) on (0, 1)."""
atan = ActionCost(
    _within(-np.pi / 2, np.pi / 2, lambda u: -jnp.log(jnp.cos(u))),
    jnp.arctan,
    lambda w: jnp.sum(w * jnp.arctan(w) - 0.5 * jnp.log1p(w**2)),
)
"""-log cos u on (-π/2, π/2)."""
tanh = ActionCost(
    _within(-1.0, 1.0, lambda u: _entropy((u + 1) / 2) + np.log(2)),
    jnp.tanh,
    # log cosh w without its overflow.
    lambda w: jnp.sum(softplus.value(2 * w) - w - np.log(2)),
)
"""The entropy of (u + 1)/2, zero at 0, on (-1, 1)."""
bang_bang = ActionCost(_within(-1.0, 1.0, lambda u: 0 * u), jnp.sign, lambda w: jnp.sum(jnp.abs(w)))
"""Zero within [-1, 1]: the control is at a limit."""
bang_lin = ActionCost(
    _within(-1.0, 1.0, lambda u: 0.5 * u**2),
    lambda w: jnp.clip(w, -1, 1),
    lambda w: jnp.sum(jnp.where(jnp.abs(w) <= 1, 0.5 * w**2, jnp.abs(w) - 0.5)),
)
"""½ u² within [-1, 1]: linear up to the limits."""


def scaled(cost: ActionCost, a: Any) -> ActionCost:
    """Returns a g(u/a): the range is a times as wide, for all controls."""
    _require_scale(a=a)
    return ActionCost(lambda u: a * cost.cost(u / a), lambda w: a * cost.policy(w), lambda w: a * cost.conjugate(w))


def weighted(cost: ActionCost, b: Any) -> ActionCost:
    """Returns b g(u): controls cost b times as much."""
    _require_scale(b=b)
    return ActionCost(lambda u: b * cost.cost(u), lambda w: cost.policy(w / b), lambda w: b * cost.conjugate(w / b))


def stretched(cost: ActionCost, a: Any) -> ActionCost:
    """Returns g(u / a), with a separate range for every control: a [m], or one for all."""
    a = np.asarray(a, float)
    _require_scale(a=a.min())
    return ActionCost(lambda u: cost.cost(u / a), lambda w: a * cost.policy(a * w), lambda w: cost.conjugate(a * w))


def shifted(cost: ActionCost, c: Any) -> ActionCost:
    """Returns g(u + c) - g(c): the range is shifted by -c."""
    c = jnp.asarray(c, float)
    return ActionCost(
        lambda u: cost.cost(u + c) - cost.cost(c),
        lambda w: cost.policy(w) - c,
        lambda w: cost.conjugate(w) - jnp.sum(c * w) + cost.cost(c),
    )


def centred(cost: ActionCost, u: Any) -> ActionCost:
    """Returns g minus its tangent at u0: minimal and zero at the control u0 that holds a goal, within the same limits.

    Args:
        cost: g, with a slope at u0.
        u: u0 [m].

    Raises:
        InputError: the policy of g does not return u0, which may be out of its range.
    """
    u = jnp.asarray(u, float)
    slope = jax.grad(cost.cost)(u)
    if not bool(jnp.max(jnp.abs(cost.policy(slope) - u)) <= 1e-6 * (1 + jnp.max(jnp.abs(u)))):
        raise InputError(
            f"the limits cannot hold the goal: it takes the control {np.asarray(u).tolist()}, which is out of the "
            "range of the action cost; give wider limits, or another goal"
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
    return weighted(scaled(atan, 2 * limit / np.pi), weight)


def _require_scale(**numbers: Any) -> None:
    require_positive(**{name: float(value) for name, value in numbers.items()})
