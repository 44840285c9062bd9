"""Parameters of bodies that exist: least squares over positive definite pseudo-inertias and positive coefficients.

A body has the pseudo-inertia J = L M Lᵀ, where J_0 = L Lᵀ is that of its known value and M is symmetric and positive
definite: relative to what is known, so that no coordinate has a unit. Armature and friction are c = c_0 exp(z). These
numbers minimise

    F = sum over joints of |Phi_j theta - tau_j|² / noise_j²  +  regularisation (sum of D(J | J_0) + sum of z² / 2)

D(J | J_0) = tr M - log det M - 4 is the entropic divergence of Lee, Wensing and Park (T-RO 2020); it depends on no
frame. In M the sum is convex and D is the barrier of the bodies that exist, so that F is minimised as interior-point
methods do (Boyd and Vandenberghe, Convex Optimization, chapter 11): Newton's method with a regularisation that falls
to the one that was asked for. The data are one triangle: an iteration takes some P³ operations, whatever N is.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from dln_jax.identification.columns import Columns
from dln_jax.mechanics.trees.inertia import body_of_pseudo_inertia, pseudo_inertia
from dln_jax.types import InputError, require_positive

REGULARISATION = 1.0
"""Of a body that is e times larger than it was known to be, about what one measurement counts that is wrong by twice
its noise: nothing where the data say something."""
SMALLEST = 1e-6
"""Least eigenvalue of a known pseudo-inertia, relative to its largest; where it is smaller, it is raised to it."""
UNKNOWN_SHARE = 0.01
"""Of all torque, what a coefficient that is known as zero is first taken to explain."""
FALL = 5.0
"""Factor by which the regularisation falls from one minimum to the next."""
CENTRED = 0.1
"""Newton's decrement, in units of the regularisation, at which a minimum counts as reached on the way."""
TOLERANCE = 1e-10
"""Newton's decrement, the decrease of F that is expected of another iteration, relative to 1 + F, at which to stop."""
_ABOVE = np.triu_indices(4, 1)
_BASIS = np.array(
    [np.outer(row, row) for row in np.eye(4)]
    + [(np.outer(a, b) + np.outer(b, a)) / np.sqrt(2) for a, b in zip(*np.eye(4)[np.array(_ABOVE)], strict=True)]
)
"""Orthonormal basis of the symmetric matrices [10, 4, 4]."""


class ConsistentFit(NamedTuple):
    """Bodies that exist."""

    theta: Float[np.ndarray, " P"]
    divergence: Float[np.ndarray, " bodies"]
    """D(J | J_0) of each body that there is."""
    iterations: int
    """Of Newton's method, in all."""
    converged: bool
    """Whether another iteration would change nothing that counts; else the iterations were used up."""


def is_consistent(theta: Float[np.ndarray, " P"], columns: Columns) -> tuple[bool, ...]:
    """Of each body, whether its pseudo-inertia is positive definite, or there is no body."""
    bodies = theta[np.array(columns.kinds) == "inertia"].reshape(-1, 10)
    return tuple(bool(not body.any() or np.linalg.eigvalsh(pseudo_inertia(body))[0] > 0) for body in bodies)


def nearest_body(theta: Float[np.ndarray, "10"], *, smallest: float = SMALLEST) -> Float[np.ndarray, "10"]:
    """The body whose pseudo-inertia has eigenvalues raised to `smallest` times the largest, where they are below.

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
    """The consistent parameters of least error, from those known.

    Args:
        triangle: of the equations in units of noise, as `equations.weighted`.
        columns: of the P parameters, ten of each body side by side.
        known: values to start from and to be near to; a body that does not exist is replaced by `nearest_body`, a
            coefficient that is zero by one that explains a hundredth of the torque. Where all ten numbers of a body are
            zero, there is none, and they stay.
        regularisation: dimensionless; what a unit of divergence counts, in squares of the noise. Positive, since the
            data never determine all.
        smallest: as for `nearest_body`.
        iterations: of Newton's method, at most.
        tolerance: of the decrease that is still to be had, relative to 1 + F.

    Raises:
        InputError: a regularisation that is not positive, or a body without mass.
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
    # Directions of theta: ten for each body, then those of the coefficients, then those of what has either sign.
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
    """Residuals A y + r of y = (M - 1 of each body in the basis, exp(z) - 1, what has either sign)."""

    A: np.ndarray
    r: np.ndarray
    bodies: int

    def parts(self, x: np.ndarray, coefficients: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """M [B, 4, 4], z, and what has either sign."""
        numbers, z, signed = np.split(x, [10 * self.bodies, 10 * self.bodies + coefficients])
        return np.eye(4) + np.einsum("bk,kij->bij", numbers.reshape(-1, 10), _BASIS), z, signed

    def directions(self, x: np.ndarray, coefficients: int) -> np.ndarray:
        """y of the unknowns x, of which z are logarithms."""
        y, z = x.copy(), slice(10 * self.bodies, 10 * self.bodies + coefficients)
        y[z] = np.expm1(x[z])
        return y

    def value(self, x: np.ndarray, coefficients: int, weight: float) -> float:
        """F; infinite where a body does not exist."""
        M, z, _ = self.parts(x, coefficients)
        if (M.size and np.linalg.eigvalsh(M).min() <= 0) or z.max(initial=0.0) > 100:
            return np.inf
        errors = self.A @ self.directions(x, coefficients) + self.r
        return float(errors @ errors + weight * (_divergences(M).sum() + 0.5 * z @ z))

    def newton(self, x: np.ndarray, coefficients: int, weight: float) -> tuple[np.ndarray, float]:
        """Newton's step as a least-squares problem, whose solution is stable, and its decrement."""
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
        # The second derivative of exp(z) counts where it is positive, which keeps the step one of descent.
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
    """The unknowns of least F, iterations, and whether they suffice."""
    x = np.zeros(problem.A.shape[1])
    weight = max(regularisation, problem.value(x, coefficients, 0.0) / max(1, len(x)))
    for done in range(iterations):
        step, decrement = problem.newton(x, coefficients, weight)
        now, last = problem.value(x, coefficients, weight), weight == regularisation
        if last and decrement <= tolerance * (1 + now):
            return x, done, True
        length = 1.0
        while problem.value(x + length * step, coefficients, weight) > now - 1e-4 * length * decrement:
            length /= 2
            if length < 1e-12:
                # Rounding hides what is left of F; that is an end if it is below what the sum resolves.
                return x, done, last and decrement <= 1e-8 * (1 + now)
        x = x + length * step
        if not last and decrement <= CENTRED * weight:
            weight = max(regularisation, weight / FALL)
    return x, iterations, False


def _divergences(M: np.ndarray) -> np.ndarray:
    """tr M - log det M - 4 of each."""
    return np.trace(M, axis1=1, axis2=2) - np.linalg.slogdet(M)[1] - 4


def _bodies(J: np.ndarray) -> np.ndarray:
    """Ten numbers of each pseudo-inertia, as columns."""
    return np.stack([np.asarray(body_of_pseudo_inertia(each)) for each in J], axis=1)


def _rows(places: np.ndarray, count: int) -> np.ndarray:
    """Rows of the identity matrix."""
    return np.eye(count)[places]
