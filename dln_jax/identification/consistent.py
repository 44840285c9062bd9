"""Physically consistent parameters: least squares over positive definite pseudo-inertias and positive coefficients.

A body has the pseudo-inertia J = L M Lᵀ, where J_0 = L Lᵀ is its prior and M is symmetric and positive definite. M is
relative to the prior, so its entries have no units. The armature matrix of coupled motors has the same form; its
entries between uncoupled motors are zero. All other armature and friction coefficients are c = c_0 exp(z). M and z
minimise

    F = sum over joints of |Phi_j theta - tau_j|² / noise_j²  +  regularisation (sum of D(J | J_0) + sum of z² / 2)

D(J | J_0) = tr M - log det M - n (n = 4 for a body) is the entropic divergence of Lee, Wensing and Park (T-RO 2020),
which does not depend on the frame. The sum is convex in M, and D is a barrier around the physically consistent bodies,
so an interior-point method minimises F (Boyd and Vandenberghe, Convex Optimization, chapter 11): Newton's method with
a regularisation that falls to the requested value. One triangular factor represents the data, so an iteration takes
about P³ operations for any number of samples N.
"""

from itertools import combinations_with_replacement
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from dln_jax.identification.equations import Columns, ParameterVector
from dln_jax.mechanics.trees.inertia import body_of_pseudo_inertia, pseudo_inertia
from dln_jax.types import InputError, require_positive

REGULARISATION = 1.0
"""At this value, a body e times larger than its prior costs about as much as one measurement with an error of twice its
noise, which is negligible for informative data."""
SMALLEST = 1e-6
"""Smallest eigenvalue of a prior pseudo-inertia relative to the largest; smaller ones are raised."""
UNKNOWN_SHARE = 0.01
"""Fraction of the torque that a coefficient with a zero prior explains at its initial value."""
FALL = 5.0
"""Ratio of the regularisation at successive minima."""
CENTRED = 0.1
"""Newton decrement at an intermediate minimum, in units of the regularisation."""
TOLERANCE = 1e-10
"""Newton decrement (expected decrease of F per iteration) at the end, relative to 1 + F."""
_SYMMETRIC = np.array([np.outer(a, b) + np.outer(b, a) for a, b in combinations_with_replacement(np.eye(4), 2)])
_BASIS = _SYMMETRIC / np.linalg.norm(_SYMMETRIC, axis=(1, 2), keepdims=True)
"""Orthonormal basis of the symmetric matrices [10, 4, 4]."""


class ConsistentFit(NamedTuple):
    """Physically consistent parameters and the state of the solver."""

    theta: ParameterVector
    divergence: Float[np.ndarray, " bodies"]
    """D(J | J_0) of each body with inertia."""
    iterations: int
    """Total number of Newton iterations."""
    converged: bool
    """Whether the Newton decrement fell below the tolerance; otherwise the iterations or the line search ran out."""


def nearest_body(theta: Float[np.ndarray, "10"]) -> Float[np.ndarray, "10"]:
    """Raises the eigenvalues of a pseudo-inertia to `SMALLEST` times the largest; `InputError` if none is positive."""
    theta = np.asarray(theta, float)
    values, vectors = np.linalg.eigh(pseudo_inertia(theta))
    least = SMALLEST * values[-1]
    if not least > 0:
        raise InputError("a link to identify has no mass; expected a rough value")
    if values[0] >= least:
        return theta
    return np.asarray(body_of_pseudo_inertia((vectors * np.maximum(values, least)) @ vectors.T))


def fit_consistent(
    triangle: Float[np.ndarray, "K P_and_1"],
    columns: Columns,
    known: ParameterVector,
    *,
    regularisation: float = REGULARISATION,
    iterations: int = 500,
) -> ConsistentFit:
    """Fits physically consistent parameters by least squares, with the known values as prior.

    Args:
        triangle: triangular factor of the equations in units of noise, from `equations.whiten`.
        columns: columns of the P parameters; the ten of a body are adjacent.
        known: prior and initial values. `nearest_body` replaces an inconsistent body. A value that explains a hundredth
            of the torque replaces a zero coefficient. A body with ten zeros is absent and stays zero.
        regularisation: cost of a unit of divergence, in squares of the noise; positive, because data never determine
            all parameters.

    Raises:
        InputError: `regularisation` is not positive, or a body has no mass.
    """
    require_positive(regularisation=regularisation)
    kinds, entries = np.array(columns.kinds), columns.motors
    motors = np.setdiff1d(entries, -1)
    inertial = columns.bodies[known[columns.bodies].any(axis=1)]
    lengths = np.linalg.norm(triangle[:, :-1], axis=0)
    typical = np.linalg.norm(triangle[:, -1]) / np.where(lengths > 0, lengths, np.inf)
    typical = np.where(typical > 0, typical, 1.0)
    start = np.where((kinds == "positive") & ~(known > 0), UNKNOWN_SHARE * typical, known)
    to_theta, blocks = np.diag(np.where(kinds == "signed", typical, start)), []
    for places in inertial:
        J = pseudo_inertia(nearest_body(known[places]))
        start[places], factor = body_of_pseudo_inertia(J), np.linalg.cholesky(J)
        directions = [body_of_pseudo_inertia(factor @ E @ factor.T) for E in _BASIS]
        to_theta[np.ix_(places, places)] = np.transpose(directions)
        blocks.append((places, _BASIS))
    if motors.size:
        absent = entries < 0
        if not np.linalg.eigvalsh(np.where(absent, 0.0, start[entries]))[0] > 0:
            start[kinds == "coupling"] = 0.0
        back = np.linalg.inv(np.linalg.cholesky(np.where(absent, 0.0, start[entries])))
        relative = back @ (entries == motors[:, None, None]) @ back.T
        sizes = np.linalg.norm(relative, axis=(1, 2))
        to_theta[motors, motors] = 1 / sizes
        blocks.append((motors, relative / sizes[:, None, None]))
    z = np.setdiff1d(np.flatnonzero(kinds == "positive"), motors)
    A, r = triangle[:, :-1] @ to_theta, triangle[:, :-1] @ start - triangle[:, -1]
    y, matrices, done, converged = _minimum(A, r, blocks, z, regularisation, iterations)
    return ConsistentFit(start + to_theta @ y, _divergences(matrices[: len(inertial)]), done, converged)


def _minimum(
    A: np.ndarray,
    r: np.ndarray,
    blocks: list[tuple[np.ndarray, np.ndarray]],
    logarithmic: np.ndarray,
    regularisation: float,
    iterations: int,
) -> tuple[np.ndarray, list[np.ndarray], int, bool]:
    """Minimises F with the residuals A y + r, y = (M - 1 of each block in its basis, exp(z) - 1, signed parameters).

    Args:
        blocks: indices in the unknowns, and basis [K, n, n], of each body and of the coupled motors.
        logarithmic: indices of z in the unknowns x, which have z instead of exp(z) - 1.

    Returns:
        y, M [n, n] of each block, the number of iterations, and whether they converged.
    """

    def matrices(x: np.ndarray) -> list[np.ndarray]:
        return [np.eye(basis.shape[1]) + np.tensordot(x[own], basis, 1) for own, basis in blocks]

    def directions(x: np.ndarray) -> np.ndarray:
        y = x.copy()
        y[logarithmic] = np.expm1(x[logarithmic])
        return y

    def value(x: np.ndarray, weight: float) -> float:
        """Returns F; infinite for inconsistent bodies or z above 100."""
        M, z = matrices(x), x[logarithmic]
        if any(np.linalg.eigvalsh(block)[0] <= 0 for block in M) or z.max(initial=0.0) > 100:
            return np.inf
        errors = A @ directions(x) + r
        return float(errors @ errors + weight * (_divergences(M).sum() + 0.5 * z @ z))

    def newton(x: np.ndarray, weight: float) -> tuple[np.ndarray, float]:
        """Returns the Newton step, from a least-squares problem for numerical stability, and its decrement."""
        z, errors = x[logarithmic], A @ directions(x) + r
        slopes = A.copy()
        slopes[:, logarithmic] *= np.exp(z)
        # Only positive curvature of exp(z) counts, so that the step is a descent direction.
        bend = np.sqrt(weight / 2 + np.maximum(slopes[:, logarithmic].T @ errors, 0.0))
        rows, right = [slopes, bend[:, None] * np.eye(len(x))[logarithmic]], [-errors, -weight / 2 * z / bend]
        for (own, basis), M in zip(blocks, matrices(x), strict=True):
            C, block = np.linalg.cholesky(M), np.zeros((M.size, len(x)))
            inner = np.linalg.solve(C, np.linalg.solve(C, basis).transpose(0, 2, 1))
            block[:, own] = inner.reshape(len(basis), M.size).T
            rows.append(np.sqrt(weight / 2) * block)
            right.append(-np.sqrt(weight / 2) * (C.T @ C - np.eye(len(M))).ravel())
        system = np.concatenate(rows)
        step = np.linalg.lstsq(system, np.concatenate(right), rcond=None)[0]
        return step, float(np.sum((system @ step) ** 2))

    x = np.zeros(A.shape[1])
    weight = max(regularisation, value(x, 0.0) / len(x))
    for done in range(iterations):
        step, decrement = newton(x, weight)
        now, last, length = value(x, weight), weight == regularisation, 1.0
        if last and decrement <= TOLERANCE * (1 + now):
            return directions(x), matrices(x), done, True
        # Armijo's condition; F is infinite for inconsistent bodies, so a step never leaves the feasible set.
        while value(x + length * step, weight) > now - 1e-4 * length * decrement:
            length /= 2
            if length < 1e-12:
                # Rounding hides any further decrease; converged if the decrement is small enough.
                return directions(x), matrices(x), done, last and decrement <= 1e-8 * (1 + now)
        x = x + length * step
        if not last and decrement <= CENTRED * weight:
            weight = max(regularisation, weight / FALL)
    return directions(x), matrices(x), iterations, False


def _divergences(blocks: list[np.ndarray]) -> np.ndarray:
    """Returns tr M - log det M - n of each block."""
    return np.array([np.trace(M) - np.linalg.slogdet(M)[1] - len(M) for M in blocks])
