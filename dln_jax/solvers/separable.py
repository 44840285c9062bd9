"""Separable least squares: few nonlinear unknowns, and many that enter linearly and are solved for at every step.

    minimise over (x, n) |A(n) x - b(n)|²   =   minimise over n |(1 - U Uᵀ) b|²,   A = U S Vᵀ

by Gauss-Newton on n with damping, and Kaufman's Jacobian of the projected residual r = A x - b (Kaufman 1975, "A
variable projection method for solving separable nonlinear least squares problems")

    J = (1 - U Uᵀ) (dA/dn x - db/dn)

which leaves out a term of the order of r, and of which only products with the solution x enter. Columns of A are scaled
and its small singular values left out, as in `solvers.least_squares`; normal equations are never formed.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from dln_jax.compilation import quick_compilation
from dln_jax.types import InputError, require_positive

FIRST_DAMPING, LOWER_DAMPING, TRIALS = 1e-3, 1e-12, 30
"""Of the scaled columns of J; and steps tried before an iteration gives up."""


class SeparableSolution(NamedTuple):
    """Both kinds of unknowns, and how well the equations determine them."""

    nonlinear: Float[np.ndarray, " n"]
    linear: Float[np.ndarray, " P"]
    residuals: Float[np.ndarray, " N"]
    """A x - b."""
    rank: int
    """Of the scaled columns of A."""
    condition: float
    """Of those that count."""
    covariance: Float[np.ndarray, "K K"]
    """Of (linear, nonlinear), K = P + n, on what the equations determine: s² (GᵀG)⁺, G = [A, dA/dn x - db/dn] and
    s² = |A x - b|² / (N - rank - n); it counts what the two kinds share."""
    iterations: int
    converged: bool
    """The last iteration improved as little as asked, or none could."""


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
    """The best unknowns near a start, in float64.

    Args:
        design: (n, *arguments) -> A [N, P] and b [N], in JAX; a sample that counts less has rows of less weight. The
            same function is compiled once.
        start: n [n], away from where A and b stop depending on it; quantities that are positive go as logarithms.
        arguments: arrays, such as the data.
        iterations: at most.
        improvement: stop where an iteration lowers the sum of squares by less than this part of it.
        longest_step: of any nonlinear unknown in an iteration; damping shortens what is longer.
        rank_tolerance, negligible: of A, as in `least_squares.solve`.

    Raises:
        InputError: a start that is no vector, or gives numbers that are not finite.
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
    """(n, *arguments) -> A and b; (n, x, *arguments) -> dA/dn x - db/dn [N, n]."""

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
    """The first step that lowers the sum of squares, and the next damping; the same point where none does."""
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
    """U, S, Vᵀ of the columns of A scaled to norm 1, without what is rounding; and their norms."""
    norms = np.linalg.norm(A, axis=0)
    seen = norms > negligible * norms.max(initial=0.0)
    scale = np.where(seen, norms, 1.0)
    orthogonal, triangle = np.linalg.qr(np.where(seen, A, 0.0) / scale)
    left, sizes, right = np.linalg.svd(triangle, full_matrices=False)
    lower = np.finfo(float).eps * max(A.shape) if rank_tolerance is None else rank_tolerance
    counts = sizes > lower * sizes.max(initial=0.0)
    return orthogonal @ left[:, counts], sizes[counts], right[counts], scale


def _covariance(G: np.ndarray, at: _Projected, rank_tolerance: float | None, negligible: float) -> np.ndarray:
    _, sizes, right, scale = _svd(G, rank_tolerance, negligible)
    free = max(len(G) - len(sizes), 1)
    half = (right / sizes[:, None]) / scale
    return (at.residual @ at.residual) / free * (half.T @ half)
