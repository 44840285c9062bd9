"""Linear and separable least squares by singular value decomposition with scaled columns, in float64.

With D the diagonal of column norms of A, y = D x and the decomposition A D⁻¹ = U S Vᵀ,

    y = V (S² + ridge 1)⁻¹ S Uᵀ b        minimises |A x - b|² + ridge |D x|²

Scaled columns make rank and condition independent of the units of the unknowns (Golub and Van Loan 2013, "Matrix
Computations", sections 5.3.8 and 5.5). Singular values at rounding level are left out, which gives the shortest y among
equally good ones. A tall A is first replaced by its triangular factor; AᵀA is never formed.

A separable problem has a few nonlinear unknowns n and many linear unknowns x, which every step eliminates:

    minimise over (x, n) |A(n) x - b(n)|²   =   minimise over n |(1 - U Uᵀ) b|²,   A = U S Vᵀ

by Gauss-Newton on n with damping, and Kaufman's Jacobian of the projected residual r = A x - b (Kaufman 1975, "A
variable projection method for solving separable nonlinear least squares problems")

    J = (1 - U Uᵀ) (dA/dn x - db/dn)

which omits a term of order r and needs only products of dA/dn with the solution x.
"""

import functools
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from dln_jax.precision import quick_compilation
from dln_jax.types import InputError, require_positive

FIRST_DAMPING, LOWER_DAMPING, TRIALS = 1e-3, 1e-12, 30
"""Damping of the scaled columns of J: first value and lower bound; steps tried before an iteration gives up."""


class LeastSquaresSolution(NamedTuple):
    """The unknowns, and how well the equations determine them."""

    x: np.ndarray
    """[P]."""
    rank: int
    """Number of singular values above the tolerance. If it is below P, some combination of unknowns is undetermined."""
    condition: float
    """Ratio of the largest to the smallest of these singular values; infinite without any."""
    residual: float
    """|A x - b|."""


def solve(
    A: Float[np.ndarray, "N P"],
    b: Float[np.ndarray, " N"],
    *,
    ridge: float = 0.0,
    rank_tolerance: float | None = None,
    negligible: float = 0.0,
) -> LeastSquaresSolution:
    """Returns the x that minimises |A x - b|² + ridge |D x|²; if there are several, the one with the smallest |D x|.

    Args:
        A: coefficients; a column of zeros gives x = 0.
        ridge: dimensionless; with orthogonal columns it divides the unknowns by 1 + ridge.
        rank_tolerance: singular values below it, relative to the largest, count as zero; by default the rounding of
            the decomposition, 2.2e-16 max(N, P).
        negligible: columns with a norm below this fraction of the largest count as zero. This keeps rounding errors of
            cancelling terms from being scaled up.

    Raises:
        InputError: numbers are not finite, the ridge is negative, or a tolerance is outside [0, 1).
    """
    A, b = np.asarray(A, np.float64), np.asarray(b, np.float64)
    if not (np.isfinite(A).all() and np.isfinite(b).all()):
        raise InputError("the least-squares problem has NaN or infinite entries; check the data")
    if not ridge >= 0:
        raise InputError(f"ridge is {ridge}; expected a number >= 0")
    if rank_tolerance is None:
        rank_tolerance = float(np.finfo(np.float64).eps * max(A.shape))
    for name, value in (("rank_tolerance", rank_tolerance), ("negligible", negligible)):
        if not 0 <= value < 1:
            raise InputError(f"{name} is {value}; expected a number in [0, 1)")

    (scaled, scale), rhs = scaled_columns(A, negligible), b
    if A.shape[0] > A.shape[1] + 1:
        triangle = triangular_factor(scaled, rhs)
        scaled, rhs = triangle[:, :-1], triangle[:, -1]
    left, sizes, right = truncated_svd(scaled, rank_tolerance)
    x = right.T @ (sizes / (sizes**2 + ridge) * (left.T @ rhs)) / scale
    return LeastSquaresSolution(
        x=x,
        rank=len(sizes),
        condition=float(sizes[0] / sizes[-1]) if len(sizes) else np.inf,
        residual=float(np.linalg.norm(A @ x - b)),
    )


def solve_chunks(
    chunks: Iterable[tuple[np.ndarray, np.ndarray]],
    *,
    ridge: float = 0.0,
    rank_tolerance: float | None = None,
    negligible: float = 0.0,
) -> LeastSquaresSolution:
    """Solves equations (A, b) given in chunks of rows, with one chunk in memory at a time; arguments as for `solve`.

    The chunks are folded into one triangle, [triangle; A b] = Q R, which has the same solutions and residual.
    """
    triangle, rows = None, 0
    for A, b in chunks:
        rows += len(b)
        if triangle is not None:
            A, b = np.concatenate([triangle[:, :-1], A]), np.concatenate([triangle[:, -1], b])
        triangle = triangular_factor(A, b)
    if triangle is None:
        raise InputError("there are no equations; expected at least one")
    if rank_tolerance is None:
        rank_tolerance = float(np.finfo(np.float64).eps * max(rows, triangle.shape[1] - 1))
    return solve(triangle[:, :-1], triangle[:, -1], ridge=ridge, rank_tolerance=rank_tolerance, negligible=negligible)


def scaled_columns(A: np.ndarray, negligible: float) -> tuple[np.ndarray, np.ndarray]:
    """Returns A D⁻¹ and D, with zeros for negligible columns."""
    norms = np.linalg.norm(A, axis=0)
    seen = norms > negligible * norms.max(initial=0.0)
    scale = np.where(seen, norms, 1.0)
    return np.where(seen, A, 0.0) / scale, scale


def truncated_svd(A: np.ndarray, rank_tolerance: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns U, S and Vᵀ without singular values up to the tolerance, which is relative to the largest."""
    left, sizes, right = np.linalg.svd(A, full_matrices=False)
    counts = sizes > rank_tolerance * sizes.max(initial=0.0)
    return left[:, counts], sizes[counts], right[counts]


def triangular_factor(A: Float[np.ndarray, "N P"], b: Float[np.ndarray, " N"]) -> Float[np.ndarray, "K P_and_1"]:
    """Returns R [min(N, P + 1), P + 1] of [A b] = Q R; then |A x - b| = |R (x, -1)| for every x."""
    return np.asarray(np.linalg.qr(np.column_stack([A, b]), mode="r"))


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
    """True if the last iteration improved by no more than the limit."""


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
        start: initial n [n]; use logarithms for positive quantities.
        arguments: arrays, such as the data.
        improvement: stop if an iteration lowers the sum of squares by no more than this fraction.
        longest_step: largest step of a nonlinear unknown per iteration; damping shortens longer ones.
        rank_tolerance, negligible: for A, as in `solve`.

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
            A, b = map(np.asarray, evaluate(n, *arguments))
            if not (np.isfinite(A).all() and np.isfinite(b).all()):
                nothing = np.full(len(b), np.nan)
                return _Projected(np.zeros(A.shape[1]), nothing, np.zeros((len(b), 0)), np.inf, A)
            left, sizes, right, scale = _svd(A, rank_tolerance, negligible)
            x = (right.T @ ((left.T @ b) / sizes)) / scale
            condition = float(sizes[0] / sizes[-1]) if len(sizes) else np.inf
            return _Projected(x, A @ x - b, left, condition, A)

        at = project(n)
        if not np.isfinite(at.residual).all():
            raise InputError("the equations have NaN or infinite entries at the start; choose another start")
        damping, done, converged = FIRST_DAMPING, 0, False
        while done < iterations and not converged:
            J = np.asarray(slopes(n, at.x, *arguments))
            J = J - at.basis @ (at.basis.T @ J)
            better, trial, damping = _descend(project, n, at, J, damping, longest_step)
            before, after = at.residual @ at.residual, trial.residual @ trial.residual
            n, at, done = better, trial, done + 1
            converged = before - after <= improvement * before
        G = np.column_stack([at.matrix, np.asarray(slopes(n, at.x, *arguments))])
    _, sizes, right, scale = _svd(G, rank_tolerance, negligible)
    half = (right / sizes[:, None]) / scale
    return SeparableSolution(
        nonlinear=n,
        linear=at.x,
        residuals=at.residual,
        rank=at.basis.shape[1],
        condition=at.condition,
        covariance=(at.residual @ at.residual) / max(len(G) - len(sizes), 1) * (half.T @ half),
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


def _svd(
    A: np.ndarray, rank_tolerance: float | None = None, negligible: float = 0.0
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Returns U, S, Vᵀ of A with columns scaled to norm 1, without singular values at rounding level, and the norms."""
    scaled, scale = scaled_columns(A, negligible)
    orthogonal, triangle = np.linalg.qr(scaled)
    lower = np.finfo(float).eps * max(A.shape) if rank_tolerance is None else rank_tolerance
    left, sizes, right = truncated_svd(triangle, lower)
    return orthogonal @ left, sizes, right, scale
