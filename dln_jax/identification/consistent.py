"""Physically consistent parameters: least squares over positive definite pseudo-inertias and positive coefficients.

A body has the pseudo-inertia J = L M Lᵀ, where J_0 = L Lᵀ is its prior and M is symmetric and positive definite. M is
relative to the prior, so its entries have no units. Armature and friction are c = c_0 exp(z). M and z minimise

    F = sum over joints of |Phi_j theta - tau_j|² / noise_j²  +  regularisation (sum of D(J | J_0) + sum of z² / 2)

D(J | J_0) = tr M - log det M - 4 is the entropic divergence of Lee, Wensing and Park (T-RO 2020), which does not depend
on the frame. The sum is convex in M, and D is a barrier for the physically consistent bodies. F is therefore minimised
by an interior-point method (Boyd and Vandenberghe, Convex Optimization, chapter 11): Newton's method with a
regularisation that falls to the requested value. The data enter as one triangular factor, so an iteration takes on the
order of P³ operations, independent of the number of samples N.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from dln_jax.identification.columns import Columns
from dln_jax.mechanics.trees.inertia import body_of_pseudo_inertia, pseudo_inertia
from dln_jax.types import InputError, require_positive

REGULARISATION = 1.0
"""With this value, a body e times larger than its prior costs about as much as one measurement with an error of twice
its noise, which is negligible wherever the data are informative."""
SMALLEST = 1e-6
"""Eigenvalues of a prior pseudo-inertia below this fraction of the largest are raised to it."""
UNKNOWN_SHARE = 0.01
"""Fraction of the torque that the initial value of a coefficient explains if its prior is zero."""
FALL = 5.0
"""Factor by which the regularisation falls from one minimum to the next."""
CENTRED = 0.1
"""Newton decrement, in units of the regularisation, at which an intermediate minimum counts as reached."""
TOLERANCE = 1e-10
"""Newton decrement (expected decrease of F in another iteration), relative to 1 + F, at which to stop."""
_ABOVE = np.triu_indices(4, 1)
_BASIS = np.array(
    [np.outer(row, row) for row in np.eye(4)]
    + [(np.outer(a, b) + np.outer(b, a)) / np.sqrt(2) for a, b in zip(*np.eye(4)[np.array(_ABOVE)], strict=True)]
)
"""Orthonormal basis of the symmetric matrices [10, 4, 4]."""


class ConsistentFit(NamedTuple):
    """Physically consistent parameters and how the solver ended."""

    theta: Float[np.ndarray, " P"]
    divergence: Float[np.ndarray, " bodies"]
    """D(J | J_0) of every body with inertia."""
    iterations: int
    """Total number of Newton iterations."""
    converged: bool
    """Whether the Newton decrement fell below the tolerance; otherwise the iterations or the line search ran out."""


def is_consistent(theta: Float[np.ndarray, " P"], columns: Columns) -> tuple[bool, ...]:
    """Whether the pseudo-inertia of every body is positive definite; a body with ten zeros counts as consistent."""
    bodies = theta[np.array(columns.kinds) == "inertia"].reshape(-1, 10)
    return tuple(bool(not body.any() or np.linalg.eigvalsh(pseudo_inertia(body))[0] > 0) for body in bodies)


def nearest_body(theta: Float[np.ndarray, "10"], *, smallest: float = SMALLEST) -> Float[np.ndarray, "10"]:
    """Raises the eigenvalues of a body's pseudo-inertia to at least `smallest` times the largest.

    Raises:
        InputError: no eigenvalue is positive.
    """
    values, vectors = np.linalg.eigh(pseudo_inertia(np.asarray(theta, float)))
    if not values[-1] > 0:
        raise InputError("a link that is to be identified has no mass; expected a rough value for it")
    if values[0] >= smallest * values[-1]:
        return np.asarray(theta, float)
    return np.asarray(body_of_pseudo_inertia((vectors * np.maximum(values, smallest * values[-1])) @ vectors.T))


def fit_consistent(
    triangle: Float[np.ndarray, "K P_and_1"],
    columns: Columns,
    known: Float[np.ndarray, " P"],
    *,
    regularisation: float = REGULARISATION,
    smallest: float = SMALLEST,
    iterations: int = 500,
    tolerance: float = TOLERANCE,
) -> ConsistentFit:
    """Fits physically consistent parameters by least squares, with the known values as prior.

    Args:
        triangle: triangular factor of the equations in units of noise, from `equations.weighted`.
        columns: columns of the P parameters; the ten of a body are adjacent.
        known: prior and initial values. An inconsistent body is replaced by `nearest_body`, a zero coefficient by one
            that explains a hundredth of the torque. A body with ten zeros is absent and stays zero.
        regularisation: cost of a unit of divergence, dimensionless (in squares of the noise); positive, since data
            never determine all parameters.
        smallest: as for `nearest_body`.
        iterations: upper limit of Newton iterations.
        tolerance: Newton decrement, relative to 1 + F, at which to stop.

    Raises:
        InputError: `regularisation` or `smallest` is not positive, or a body has no mass.
    """
    require_positive(regularisation=regularisation, smallest=smallest)
    kinds = np.array(columns.kinds)
    inertial, positive, signed = (np.flatnonzero(kinds == kind) for kind in ("inertia", "positive", "signed"))
    inertial = inertial.reshape(-1, 10)[known[inertial].reshape(-1, 10).any(axis=1)]
    lengths = np.linalg.norm(triangle[:, :-1], axis=0)
    typical = np.linalg.norm(triangle[:, -1]) / np.where(lengths > 0, lengths, np.inf)
    typical = np.where(typical > 0, typical, 1.0)
    start = np.zeros(len(kinds))
    start[positive] = np.where(known[positive] > 0, known[positive], UNKNOWN_SHARE * typical[positive])
    start[signed] = known[signed]
    # Columns of the map to theta: ten per body, then the positive coefficients, then the signed ones.
    maps = []
    for places in inertial:
        J = pseudo_inertia(nearest_body(known[places], smallest=smallest))
        start[places], factor = np.asarray(body_of_pseudo_inertia(J)), np.linalg.cholesky(J)
        maps.append(_rows(places, len(kinds)).T @ _bodies(factor @ _BASIS @ factor.T))
    maps += [_rows(positive, len(kinds)).T * start[positive], _rows(signed, len(kinds)).T * typical[signed]]
    problem = _Problem(triangle[:, :-1] @ np.hstack(maps), triangle[:, :-1] @ start - triangle[:, -1], len(inertial))
    x, done, converged = _minimum(problem, len(positive), regularisation, iterations, tolerance)
    M, _, _ = problem.parts(x, len(positive))
    theta = start + np.hstack(maps) @ problem.directions(x, len(positive))
    return ConsistentFit(theta, _divergences(M), done, converged)


class _Problem(NamedTuple):
    """Residuals A y + r with y = (M - 1 of every body in the basis, exp(z) - 1, signed parameters)."""

    A: np.ndarray
    r: np.ndarray
    bodies: int

    def parts(self, x: np.ndarray, coefficients: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """M [B, 4, 4], z, and the signed parameters."""
        numbers, z, signed = np.split(x, [10 * self.bodies, 10 * self.bodies + coefficients])
        return np.eye(4) + np.einsum("bk,kij->bij", numbers.reshape(-1, 10), _BASIS), z, signed

    def directions(self, x: np.ndarray, coefficients: int) -> np.ndarray:
        """y as a function of the unknowns x, which hold z in place of exp(z) - 1."""
        y, z = x.copy(), slice(10 * self.bodies, 10 * self.bodies + coefficients)
        y[z] = np.expm1(x[z])
        return y

    def value(self, x: np.ndarray, coefficients: int, weight: float) -> float:
        """F; infinite where a body is not physically consistent or z exceeds 100."""
        M, z, _ = self.parts(x, coefficients)
        if (M.size and np.linalg.eigvalsh(M).min() <= 0) or z.max(initial=0.0) > 100:
            return np.inf
        errors = self.A @ self.directions(x, coefficients) + self.r
        return float(errors @ errors + weight * (_divergences(M).sum() + 0.5 * z @ z))

    def newton(self, x: np.ndarray, coefficients: int, weight: float) -> tuple[np.ndarray, float]:
        """The Newton step, solved as a least-squares problem for numerical stability, and its decrement."""
        M, z, signed = self.parts(x, coefficients)
        errors = self.A @ self.directions(x, coefficients) + self.r
        scale = np.concatenate([np.ones(10 * self.bodies), np.exp(z), np.ones(len(signed))])
        slopes = self.A * scale
        rows, right = [slopes], [-errors]
        for body, each in enumerate(M):
            C = np.linalg.cholesky(each)
            inner = np.linalg.solve(C, np.linalg.solve(C, _BASIS).transpose(0, 2, 1))
            block = np.zeros((16, len(x)))
            block[:, 10 * body : 10 * body + 10] = inner.reshape(10, 16).T
            rows.append(np.sqrt(weight / 2) * block)
            right.append(-np.sqrt(weight / 2) * (C.T @ C - np.eye(4)).ravel())
        # The curvature of exp(z) enters only where it is positive, so that the step remains a descent direction.
        place = 10 * self.bodies + np.arange(coefficients)
        bend = np.sqrt(weight / 2 + np.maximum(slopes[:, place].T @ errors, 0.0))
        rows.append(bend[:, None] * _rows(place, len(x)))
        right.append(-weight / 2 * z / bend)
        system = np.concatenate(rows)
        step = np.linalg.lstsq(system, np.concatenate(right), rcond=None)[0]
        return step, float(np.sum((system @ step) ** 2))


def _minimum(
    problem: _Problem, coefficients: int, regularisation: float, iterations: int, tolerance: float
) -> tuple[np.ndarray, int, bool]:
    """The unknowns that minimise F, the number of iterations, and whether they converged."""
    x = np.zeros(problem.A.shape[1])
    weight = max(regularisation, problem.value(x, coefficients, 0.0) / max(1, len(x)))
    for done in range(iterations):
        step, decrement = problem.newton(x, coefficients, weight)
        now, last = problem.value(x, coefficients, weight), weight == regularisation
        if last and decrement <= tolerance * (1 + now):
            return x, done, True
        length = 1.0
        # Armijo's condition; F is infinite for inconsistent bodies, so a step never leaves the feasible set.
        while problem.value(x + length * step, coefficients, weight) > now - 1e-4 * length * decrement:
            length /= 2
            if length < 1e-12:
                # Rounding hides any further decrease; this counts as converged if the decrement is small enough.
                return x, done, last and decrement <= 1e-8 * (1 + now)
        x = x + length * step
        if not last and decrement <= CENTRED * weight:
            weight = max(regularisation, weight / FALL)
    return x, iterations, False


def _divergences(M: np.ndarray) -> np.ndarray:
    """tr M - log det M - 4 of every body."""
    return np.trace(M, axis1=1, axis2=2) - np.linalg.slogdet(M)[1] - 4


def _bodies(J: np.ndarray) -> np.ndarray:
    """The ten inertial parameters of every pseudo-inertia, as columns."""
    return np.stack([np.asarray(body_of_pseudo_inertia(each)) for each in J], axis=1)


def _rows(places: np.ndarray, count: int) -> np.ndarray:
    """Rows of the identity matrix."""
    return np.eye(count)[places]
