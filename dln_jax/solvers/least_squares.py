"""Linear least squares with scaled columns, by the singular value decomposition, in float64.

With D the diagonal of column norms of A, y = D x and the decomposition A D⁻¹ = U S Vᵀ,

    y = V (S² + ridge 1)⁻¹ S Uᵀ b        minimises |A x - b|² + ridge |D x|²

Scaled columns make rank and condition independent of the units of the unknowns (Golub and Van Loan 2013, "Matrix
Computations", sections 5.3.8 and 5.5). Singular values that are only rounding are left out, which gives the shortest y
of all that fit equally well. A tall A is first replaced by its triangular factor; AᵀA is never formed.
"""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from dln_jax.types import InputError


class LeastSquaresSolution(NamedTuple):
    """The unknowns, and how well the equations determine them."""

    x: np.ndarray
    """[P]."""
    rank: int
    """Number of singular values above the tolerance; if below P, a combination of unknowns is undetermined."""
    condition: float
    """Ratio of the largest to the smallest of these singular values; infinite if there are none."""
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
        negligible: columns with a norm up to this fraction of the largest count as zero, so that rounding left by
            cancelling terms is not scaled up to the size of the other columns.

    Raises:
        InputError: numbers are not finite, the ridge is negative, or a tolerance is outside [0, 1).
    """
    A, b = np.asarray(A, np.float64), np.asarray(b, np.float64)
    if not (np.isfinite(A).all() and np.isfinite(b).all()):
        raise InputError(
            "the least-squares problem has NaN or infinite entries; expected finite ones: look at the data"
        )
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
    """Solves equations (A, b) that come in chunks of rows, holding one chunk at a time; arguments as for `solve`.

    The chunks are folded into one triangle, [triangle; A b] = Q R, which has the same solutions and residual.
    """
    triangle, rows = None, 0
    for A, b in chunks:
        rows += len(b)
        if triangle is not None:
            A, b = np.concatenate([triangle[:, :-1], A]), np.concatenate([triangle[:, -1], b])
        triangle = triangular_factor(A, b)
    if triangle is None:
        raise InputError("there are no equations to solve; expected at least one")
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
    """Returns R [min(N, P + 1), P + 1] of [A b] = Q R, for which |A x - b| = |R (x, -1)| for every x."""
    return np.asarray(np.linalg.qr(np.column_stack([A, b]), mode="r"))
