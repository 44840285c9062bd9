"""Linear-quadratic regulators at an equilibrium, in continuous or sampled time, and along a trajectory.

    J = integral (x - x0)ᵀ Q (x - x0) + (u - u0)ᵀ R (u - u0) dt,   u = u0 - K (x - x0),   J(x) = (x - x0)ᵀ S (x - x0)

SciPy (imported on use) solves the Riccati equations for constant matrices. The backward recursion along a trajectory is
differentiable. Angle errors are wrapped.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Bool, Float

from dln_jax.control.closed_loop import Hardware, simulate, stateless
from dln_jax.control.state_space import Field, Law, error, where_finite
from dln_jax.types import InputError, JointKind, Scalar, require_positive

NEGLIGIBLE = 1e-12
"""Rounding of eigenvalues: relative to the largest entry of a cost, or absolute (1/s or 1) for decay."""


class Regulator(NamedTuple):
    """u = u0 - K (x - x0)."""

    K: Float[Array, "m n"]
    S: Float[Array, "n n"]
    """The cost to go is (x - x0)ᵀ S (x - x0)."""


class Region(NamedTuple):
    """Region around a goal with a cost to go of at most a level."""

    level: float
    """Level of (x - x0)ᵀ S (x - x0)."""
    share: float
    """Share of the tested starts that reached the goal."""


def lqr(A: Any, B: Any, Q: Any, R: Any) -> Regulator:
    """Returns the regulator in continuous time.

    Args:
        A: [n, n].
        B: [n, m].
        Q: cost of the state [n, n], symmetric, positive semi-definite.
        R: cost of the controls [m, m], symmetric, positive definite.

    Raises:
        InputError: shapes do not agree, a cost is not definite, or no control stabilises the system.
    """
    from scipy.linalg import solve_continuous_are

    A, B, Q, R = _checked(A, B, Q, R)
    gain = lambda S: np.linalg.solve(R, B.T @ S)  # noqa: E731
    return _regulator(A, B, lambda: solve_continuous_are(A, B, Q, R), gain, decay=lambda values: -values.real)


def sampled_lqr(A: Any, B: Any, Q: Any, R: Any, dt: float) -> Regulator:
    """Returns the regulator for controls held for dt, with the cost sum dt (xᵀ Q x + uᵀ R u) at the samples.

    Args:
        A: in continuous time [n, n].
        B: [n, m].
        Q: as for `lqr`.
        R: as for `lqr`.
        dt: s.

    Raises:
        InputError: as for `lqr`, or dt is not positive.
    """
    from scipy.linalg import solve_discrete_are

    require_positive(dt=dt)
    A, B, Q, R = _checked(A, B, Q, R)
    F, G = held(A, B, dt)
    gain = lambda S: np.linalg.solve(dt * R + G.T @ S @ G, G.T @ S @ F)  # noqa: E731
    return _regulator(
        F, G, lambda: solve_discrete_are(F, G, dt * Q, dt * R), gain, decay=lambda values: 1 - abs(values)
    )


def held(A: Any, B: Any, dt: float) -> tuple[np.ndarray, np.ndarray]:
    """Returns F and G in x(t + dt) = F x + G u with held controls."""
    from scipy.signal import cont2discrete

    system: Any = cont2discrete((A, B, np.eye(len(A)), np.zeros_like(B)), dt)
    return system[0], system[1]


def time_varying_lqr(F: Any, G: Any, Q: Any, R: Any, S_end: Any) -> Regulator:
    """Returns regulators along a trajectory of N steps, by the backward Riccati recursion; pure and differentiable.

    K is [N, m, n], and S is [N + 1, n, n]: at the steps and at the end.

    Args:
        F: [N, n, n], of the steps x' = F x + G u.
        G: [N, n, m].
        Q: cost of the state [n, n], or [N, n, n].
        R: cost of the controls [m, m], or [N, m, m].
        S_end: cost of the last state [n, n].
    """
    Q, R = (jnp.broadcast_to(jnp.asarray(cost), (len(F), *np.shape(cost)[-2:])) for cost in (Q, R))

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
    return Regulator(K, jnp.concatenate([S, S_end[None]]))


def regulated(regulator: Regulator, goal: Any, controls: Any, joints: tuple[JointKind, ...]) -> Law:
    """Returns the law u = u0 - K (x - x0)."""
    return lambda x: where_finite(jnp.asarray(controls) - regulator.K @ error(x, goal, joints), x)


def value(regulator: Regulator, goal: Any, joints: tuple[JointKind, ...]) -> Callable[[Array], Scalar]:
    """Returns the cost to go x -> (x - x0)ᵀ S (x - x0)."""

    def cost(x: Array) -> Scalar:
        difference = error(x, goal, joints)
        return difference @ regulator.S @ difference

    return cost


def switched(far: Law, near: Law, cost: Callable[[Array], Scalar], level: Any) -> Law:
    """Returns the law `near` where the cost to go is at most the level, and `far` elsewhere."""
    # Both laws are evaluated; the inactive one may be NaN.
    return lambda x: where_finite(jnp.where(cost(x) <= level, near(x), far(x)), x)


def region_of_attraction(
    field: Field,
    law: Law,
    regulator: Regulator,
    goal: Any,
    joints: tuple[JointKind, ...],
    *,
    lower: Any = -jnp.inf,
    upper: Any = jnp.inf,
    rate: float = 500.0,
    seconds: float = 5.0,
    levels: Any = None,
    starts: int = 64,
    key: Array | None = None,
) -> Region:
    """Returns the largest level with only successful simulations from random starts on its surface and below it.

    Args:
        field: (x, u) -> dx/dt of the plant.
        law: x -> u near the goal.
        regulator: its S shapes the region.
        goal: x0 [2 d].
        joints: kinds of the joints.
        lower: lower limits of the controls.
        upper: upper limits of the controls.
        rate: sampling rate, Hz.
        seconds: time within which the cost to go must fall to a hundredth of the level.
        levels: ascending; by default 10⁻³ to 10³ times the trace of S, five per decade.
        starts: number of starts on every surface.
        key: random key of the starts.
    """
    require_positive(starts=starts, rate=rate, seconds=seconds)
    m, n = regulator.K.shape
    levels = np.asarray(np.trace(regulator.S) * 10 ** np.arange(-3, 3.01, 0.2) if levels is None else levels, float)
    sizes, axes = np.linalg.eigh(np.asarray(regulator.S))
    drawn = jax.random.normal(jax.random.key(0) if key is None else key, (starts, n))
    sphere = drawn / jnp.linalg.norm(drawn, axis=1, keepdims=True)
    surface = (sphere / np.sqrt(sizes)) @ axes.T
    cost, hardware = value(regulator, goal, joints), Hardware(lower, upper)

    @jax.jit
    def arrives(level: Array) -> Bool[Array, " starts"]:
        def one(start: Array) -> Array:
            run = simulate(
                field, stateless(law), jnp.asarray(goal) + jnp.sqrt(level) * start,
                seconds=seconds, rate=rate, controls=m, hardware=hardware,
            )  # fmt: skip
            return cost(run.x[-1]) <= 0.01 * level

        return jax.vmap(one)(surface)

    region = Region(0.0, 1.0)
    for level in levels:
        share = float(jnp.mean(arrives(jnp.asarray(level))))
        if share < 1:
            break
        region = Region(float(level), share)
    return region


def _checked(A: Any, B: Any, Q: Any, R: Any) -> tuple[np.ndarray, ...]:
    A, B, Q, R = (np.asarray(matrix, float) for matrix in (A, B, Q, R))
    n, m = B.shape if B.ndim == 2 else (0, 0)
    for name, matrix, size in (("A", A, n), ("Q", Q, n), ("R", R, m)):
        if matrix.shape != (size, size) or not n:
            expected = "[m, m]" if name == "R" else "[n, n]"
            raise InputError(
                f"{name} has shape {matrix.shape} and B {B.shape}; expected {name} {expected} and B [n, m]"
            )
        if not np.isfinite(matrix).all():
            raise InputError(f"{name} is not finite")
    for name, matrix, kind, lower in (("Q", Q, "semi-definite", -NEGLIGIBLE), ("R", R, "definite", 0.0)):
        sizes = np.linalg.eigvalsh(matrix)
        if not np.allclose(matrix, matrix.T) or sizes.min() <= lower * max(abs(matrix).max(), 1e-300):
            raise InputError(f"{name} is not symmetric and positive {kind}; expected a convex cost")
    return A, B, Q, R


def _regulator(A: np.ndarray, B: np.ndarray, solve: Any, gain: Any, *, decay: Any) -> Regulator:
    """Returns the regulator from the solution of a Riccati equation, if all eigenvalues of the closed loop decay.

    The Hautus test comes first: [A - s I, B] must have full rank at every eigenvalue s that does not decay.
    """
    values, size = np.linalg.eigvals(A), max(np.linalg.norm(A), np.linalg.norm(B), 1e-300)
    for value in values[decay(values) <= NEGLIGIBLE]:
        sizes = np.linalg.svd(np.hstack([A - value * np.eye(len(A)), B]), compute_uv=False)
        if sizes[-1] <= 1e-9 * size:
            raise InputError(
                f"the linearisation is not controllable: the mode with eigenvalue {value:.3g} does not decay, and "
                "no control affects it; choose another equilibrium, or another motor"
            )
    expected = "every unstable mode must have a cost"
    try:
        S = solve()
    except (np.linalg.LinAlgError, ValueError) as error:
        raise InputError(f"the Riccati equation has no solution ({error}); {expected}") from None
    K = gain(S)
    if not decay(np.linalg.eigvals(A - B @ K)).min() > 0:
        raise InputError(f"the Riccati equation has no stabilising solution; {expected}")
    return Regulator(jnp.asarray(K), jnp.asarray(S))
