"""Separable least squares: a few nonlinear unknowns, and many linear ones that are eliminated in every step.

    minimise over (x, n) |A(n) x - b(n)|²   =   minimise over n |(1 - U Uᵀ) b|²,   A = U S Vᵀ

by Gauss-Newton on n with damping, and Kaufman's Jacobian of the projected residual r = A x - b (Kaufman 1975, "A
variable projection method for solving separable nonlinear least squares problems")

    J = (1 - U Uᵀ) (dA/dn x - db/dn)

which omits a term of the order of r and needs only products of dA/dn with the solution x. Columns of A are scaled and
its small singular values omitted, as in `solvers.least_squares`; normal equations are never formed.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from dln_jax.precision import quick_compilation
from dln_jax.solvers.least_squares import scaled_columns, truncated_svd
from dln_jax.types import InputError, require_positive

FIRST_DAMPING, LOWER_DAMPING, TRIALS = 1e-3, 1e-12, 30
"""Damping of the scaled columns of J: first value and lower bound; steps tried before an iteration gives up."""


class SeparableSolution(NamedTuple):
    """Both kinds of unknowns, and how well the equations determine them."""

    nonlinear: Float[np.ndarray, " n"]
    linear: Float[np.ndarray, " P"]
    residuals: Float[np.ndarray, " N"]
    """A x - b."""
    rank: int
    """Rank of the scaled columns of A."""
    condition: float
    """Condition number of these columns, on their rank."""
    covariance: Float[np.ndarray, "K K"]
    """Covariance of (linear, nonlinear), K = P + n, on the determined combinations: s² (GᵀG)⁺ with
    G = [A, dA/dn x - db/dn] and s² = |A x - b|² / (N - rank - n); includes correlations between the two."""
    iterations: int
    converged: bool
    """Whether the last iteration improved by no more than the limit, or not at all."""


class _Projected(NamedTuple):
    x: np.ndarray
    residual: np.ndarray
    basis: np.ndarray
    """U [N, rank]."""
    condition: float
    matrix: np.ndarray


def solve_separable(
    design: Callable[..., tuple[Any, Any]],
    start: Any,
    *arguments: Any,
    iterations: int = 50,
    improvement: float = 1e-10,
    longest_step: float = np.inf,
    rank_tolerance: float | None = None,
    negligible: float = 0.0,
) -> SeparableSolution:
    """Returns the unknowns of a local minimum near the start, in float64.

    Args:
        design: (n, *arguments) -> A [N, P] and b [N], in JAX; sample weights multiply their rows. Compiled once.
        start: initial n [n]; pass positive quantities as logarithms.
        arguments: arrays, such as the data.
        improvement: stop if an iteration lowers the sum of squares by no more than this fraction.
        longest_step: largest step of a nonlinear unknown per iteration; damping shortens longer ones.
        rank_tolerance, negligible: for A, as in `least_squares.solve`.

    Raises:
        InputError: the start is not a vector, or gives numbers that are not finite.
    """
    require_positive(iterations=iterations, longest_step=longest_step)
    with jax.enable_x64(True):
        n = np.asarray(start, np.float64)
        if n.ndim != 1 or n.size == 0:
            raise InputError(f"start has shape {n.shape}; expected a vector of at least one unknown")
        evaluate, slopes = _compiled(design)

        def project(n: np.ndarray) -> _Projected:
            A, b = evaluate(n, *arguments)
            return _projected(np.asarray(A), np.asarray(b), rank_tolerance, negligible)

        at = project(n)
        if not np.isfinite(at.residual).all():
            raise InputError("the equations have NaN or infinite entries at the start; expected finite ones")
        damping, done, converged = FIRST_DAMPING, 0, False
        while done < iterations and not converged:
            J = np.asarray(slopes(n, at.x, *arguments))
            J = J - at.basis @ (at.basis.T @ J)
            better, trial, damping = _descend(project, n, at, J, damping, longest_step)
            before, after = at.residual @ at.residual, trial.residual @ trial.residual
            n, at, done = better, trial, done + 1
            converged = before - after <= improvement * before
        G = np.column_stack([at.matrix, np.asarray(slopes(n, at.x, *arguments))])
    return SeparableSolution(
        nonlinear=n,
        linear=at.x,
        residuals=at.residual,
        rank=at.basis.shape[1],
        condition=at.condition,
        covariance=_covariance(G, at, rank_tolerance, negligible),
        iterations=done,
        converged=bool(converged),
    )


@functools.lru_cache(maxsize=8)
def _compiled(design: Callable[..., tuple[Any, Any]]) -> tuple[Callable[..., Any], Callable[..., Any]]:
    """Returns (n, *arguments) -> A and b, and (n, x, *arguments) -> dA/dn x - db/dn [N, n], both compiled."""

    def slopes(n, x, *arguments):
        def residual(n):
            A, b = design(n, *arguments)
            return A @ x - b

        return jax.jacfwd(residual)(n)

    options = quick_compilation()
    return jax.jit(design, compiler_options=options), jax.jit(slopes, compiler_options=options)


def _descend(
    project: Callable[[np.ndarray], _Projected],
    n: np.ndarray,
    at: _Projected,
    J: np.ndarray,
    damping: float,
    longest_step: float,
) -> tuple[np.ndarray, _Projected, float]:
    """Takes the first step that lowers the sum of squares, if any; returns the point and the next damping."""
    left, sizes, right, scale = _svd(J)
    slope = left.T @ at.residual
    for _ in range(TRIALS if len(sizes) else 0):
        step = -(right.T @ (sizes / (sizes**2 + damping) * slope)) / scale
        if np.abs(step).max() > longest_step:
            damping *= 5
            continue
        trial = project(n + step)
        if trial.residual @ trial.residual < at.residual @ at.residual:  # False for NaN
            return n + step, trial, max(damping / 9, LOWER_DAMPING)
        damping *= 5
    return n, at, damping


def _projected(A: np.ndarray, b: np.ndarray, rank_tolerance: float | None, negligible: float) -> _Projected:
    if not (np.isfinite(A).all() and np.isfinite(b).all()):
        nothing = np.full(len(b), np.nan)
        return _Projected(np.zeros(A.shape[1]), nothing, np.zeros((len(b), 0)), np.inf, A)
    left, sizes, right, scale = _svd(A, rank_tolerance, negligible)
    x = (right.T @ ((left.T @ b) / sizes)) / scale
    condition = float(sizes[0] / sizes[-1]) if len(sizes) else np.inf
    return _Projected(x, A @ x - b, left, condition, A)


def _svd(
    A: np.ndarray, rank_tolerance: float | None = None, negligible: float = 0.0
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Returns U, S, Vᵀ of A with columns scaled to norm 1, without singular values at rounding level, and the norms."""
    scaled, scale = scaled_columns(A, negligible)
    orthogonal, triangle = np.linalg.qr(scaled)
    lower = np.finfo(float).eps * max(A.shape) if rank_tolerance is None else rank_tolerance
    left, sizes, right = truncated_svd(triangle, lower)
    return orthogonal @ left, sizes, right, scale


def _covariance(G: np.ndarray, at: _Projected, rank_tolerance: float | None, negligible: float) -> np.ndarray:
    _, sizes, right, scale = _svd(G, rank_tolerance, negligible)
    free = max(len(G) - len(sizes), 1)
    half = (right / sizes[:, None]) / scale
    return (at.residual @ at.residual) / free * (half.T @ half)
