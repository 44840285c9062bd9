"""Linear-quadratic regulators: at an equilibrium in continuous and in sampled time, and along a trajectory.

    J = integral (x - x0)ᵀ Q (x - x0) + (u - u0)ᵀ R (u - u0) dt,   u = u0 - K (x - x0),   J(x) = (x - x0)ᵀ S (x - x0)

SciPy solves the Riccati equations of constant matrices (`scipy.linalg.solve_continuous_are`, imported on use); the
backward recursion along a trajectory is our own, and differentiable.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from dln_jax.types import InputError, require_positive


class Regulator(NamedTuple):
    """u = u0 - K (x - x0)."""

    K: Float[Array, "m n"]
    S: Float[Array, "n n"]
    """The cost to go is (x - x0)ᵀ S (x - x0)."""


class SampledRegulators(NamedTuple):
    """Regulators of the steps of a trajectory, and the costs to go at the steps and at the end."""

    K: Float[Array, "N m n"]
    S: Float[Array, "N+1 n n"]


def lqr(A: Any, B: Any, Q: Any, R: Any) -> Regulator:
    """Returns the regulator in continuous time.

    Args:
        A: [n, n].
        B: [n, m].
        Q: cost of the state [n, n], symmetric, positive semi-definite.
        R: cost of the controls [m, m], symmetric, positive definite.

    Raises:
        InputError: shapes that do not agree, costs that are not definite, or a system that no control stabilises.
    """
    from scipy.linalg import LinAlgError, solve_continuous_are

    A, B, Q, R = _checked(A, B, Q, R)
    _require_stabilisable(A, B, lambda values: values.real >= -1e-12)
    try:
        S = solve_continuous_are(A, B, Q, R)
    except (LinAlgError, ValueError) as error:
        raise _no_solution(error) from None
    K = np.linalg.solve(R, B.T @ S)
    _require_stable(np.max(np.real(np.linalg.eigvals(A - B @ K))) < 0)
    return Regulator(jnp.asarray(K), jnp.asarray(S))


def sampled_lqr(A: Any, B: Any, Q: Any, R: Any, dt: float) -> Regulator:
    """Returns the regulator for controls held for dt, with the cost sum dt (xᵀ Q x + uᵀ R u) at the samples.

    Args:
        A: of continuous time [n, n].
        B: [n, m].
        Q: as for `lqr`.
        R: as for `lqr`.
        dt: s.

    Raises:
        InputError: as for `lqr`, or a time that is not positive.
    """
    from scipy.linalg import LinAlgError, solve_discrete_are

    require_positive(dt=dt)
    A, B, Q, R = _checked(A, B, Q, R)
    F, G = held(A, B, dt)
    _require_stabilisable(F, G, lambda values: abs(values) >= 1 - 1e-12)
    try:
        S = solve_discrete_are(F, G, dt * Q, dt * R)
    except (LinAlgError, ValueError) as error:
        raise _no_solution(error) from None
    K = np.linalg.solve(dt * R + G.T @ S @ G, G.T @ S @ F)
    _require_stable(abs(np.linalg.eigvals(F - G @ K)).max() < 1)
    return Regulator(jnp.asarray(K), jnp.asarray(S))


def held(A: Any, B: Any, dt: float) -> tuple[np.ndarray, np.ndarray]:
    """F and G in x(t + dt) = F x + G u with held controls, by one exponential of [[A, B], [0, 0]]."""
    from scipy.linalg import expm

    n, m = np.shape(B)
    both = np.zeros((n + m, n + m))
    both[:n, :n], both[:n, n:] = A, B
    powers = expm(dt * both)
    return powers[:n, :n], powers[:n, n:]


def time_varying_lqr(F: Any, G: Any, Q: Any, R: Any, S_end: Any) -> SampledRegulators:
    """Returns regulators along a trajectory of N steps, by the backward Riccati recursion; pure and differentiable.

    Args:
        F: of the steps x' = F x + G u [N, n, n].
        G: [N, n, m].
        Q: cost of the state [n, n], or [N, n, n].
        R: cost of the controls [m, m], or [N, m, m].
        S_end: cost of the last state [n, n].
    """
    steps = len(F)
    Q, R = (jnp.broadcast_to(jnp.asarray(each), (steps, *np.shape(each)[-2:])) for each in (Q, R))

    def back(S: Array, step: tuple[Array, ...]) -> tuple[Array, tuple[Array, Array]]:
        F, G, Q, R = step
        SG = S @ G
        K = jnp.linalg.solve(R + G.T @ SG, SG.T @ F)
        closed = F - G @ K
        # Joseph's form stays symmetric and definite under rounding.
        before = Q + K.T @ R @ K + closed.T @ S @ closed
        return before, (K, before)

    S_end = jnp.asarray(S_end)
    _, (K, S) = jax.lax.scan(back, S_end, (jnp.asarray(F), jnp.asarray(G), Q, R), reverse=True)
    return SampledRegulators(K, jnp.concatenate([S, S_end[None]]))


def _checked(A: Any, B: Any, Q: Any, R: Any) -> tuple[np.ndarray, ...]:
    A, B, Q, R = (np.asarray(each, float) for each in (A, B, Q, R))
    n, m = B.shape if B.ndim == 2 else (0, 0)
    for name, each, shape in (("A", A, (n, n)), ("Q", Q, (n, n)), ("R", R, (m, m))):
        if each.shape != shape or not n:
            wanted = "[m, m]" if name == "R" else "[n, n]"
            raise InputError(f"{name} has shape {each.shape} and B {B.shape}; expected {name} {wanted} and B [n, m]")
        if not np.isfinite(each).all():
            raise InputError(f"{name} is not finite")
    for name, each, least in (("Q", Q, -1e-12), ("R", R, 0.0)):
        if not np.allclose(each, each.T) or np.linalg.eigvalsh(each).min() <= least * max(abs(each).max(), 1e-300):
            kind = "definite" if name == "R" else "semi-definite"
            raise InputError(f"{name} is not symmetric and positive {kind}; expected a cost that is")
    return A, B, Q, R


def _require_stabilisable(A: np.ndarray, B: np.ndarray, unstable: Any) -> None:
    """Hautus test: [A - s I, B] has full rank at every eigenvalue s that does not decay by itself."""
    values = np.linalg.eigvals(A)
    size = max(np.linalg.norm(A), np.linalg.norm(B), 1e-300)
    for value in values[unstable(values)]:
        sizes = np.linalg.svd(np.hstack([A - value * np.eye(len(A)), B]), compute_uv=False)
        if sizes[-1] <= 1e-9 * size:
            raise InputError(
                f"the linearisation is not controllable: its mode of eigenvalue {value:.3g} does not decay, and no "
                "control reaches it; choose another equilibrium, or another motor"
            )


def _require_stable(stable: Any) -> None:
    if not bool(stable):
        raise InputError(
            "the Riccati equation has no stabilising solution; expected costs that see every unstable mode"
        )


def _no_solution(error: Exception) -> InputError:
    return InputError(f"the Riccati equation has no solution ({error}); expected costs that see every unstable mode")
