"""Parameters of bodies that exist: least squares over positive definite pseudo-inertias and positive coefficients.

A body has the pseudo-inertia J = L (E Eᵀ) Lᵀ, where J_0 = L Lᵀ is that of its known value (L upper triangular) and E is
upper triangular with the exponentials of four numbers on its diagonal and six numbers above it: the log-Cholesky
parametrisation of Rucker and Wensing (RA-L 2022), relative to what is known, so that no coordinate has a unit. Armature
and friction are c = c_0 exp(z). These numbers minimise

    sum over joints of |Phi_j theta - tau_j|² / noise_j²  +  regularisation (sum of D(J | J_0) + sum of z² / 2)

D(J | J_0) = tr(J J_0⁻¹) - log det(J J_0⁻¹) - 4 is the entropic divergence of Lee, Wensing and Park (T-RO 2020). In
these coordinates it is a sum of ten squares, and so made for Gauss-Newton; it depends on no frame. The data are one
triangle: an iteration takes some P³ operations, whatever N is.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from dln_jax.compilation import quick_compilation
from dln_jax.identification.columns import Columns
from dln_jax.mechanics.trees.inertia import body_of_pseudo_inertia, pseudo_inertia
from dln_jax.solvers import levenberg_marquardt
from dln_jax.types import InputError, require_positive

REGULARISATION = 1.0
"""Of a body that is e times larger than it was known to be, about what one measurement counts that is wrong by twice
its noise: nothing where the data say something."""
SMALLEST = 1e-6
"""Least eigenvalue of a known pseudo-inertia, relative to its largest; where it is smaller, it is raised to it."""
UNKNOWN_SHARE = 0.01
"""Of all torque, what a coefficient that is known as zero is first taken to explain."""
_ABOVE = np.triu_indices(4, 1)


class ConsistentFit(NamedTuple):
    """Bodies that exist."""

    theta: Float[np.ndarray, " P"]
    divergence: Float[np.ndarray, " bodies"]
    """D(J | J_0) of each body that there is."""
    iterations: int
    status: levenberg_marquardt.Status


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
    iterations: int = 300,
    improvement: float = 1e-10,
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
        iterations: of Levenberg-Marquardt, at most.
        improvement: relative decrease of the sum at which to stop.

    Raises:
        InputError: a regularisation that is not positive, or a body without mass.
    """
    require_positive(regularisation=regularisation, smallest=smallest)
    kinds = np.array(columns.kinds)
    inertial, positive, signed = (np.flatnonzero(kinds == kind) for kind in ("inertia", "positive", "signed"))
    inertial = inertial.reshape(-1, 10)[known[inertial].reshape(-1, 10).any(axis=1)]
    bodies = [nearest_body(theta, smallest=smallest) for theta in known[inertial]]
    lengths = np.linalg.norm(triangle[:, :-1], axis=0)
    typical = np.linalg.norm(triangle[:, -1]) / np.where(lengths > 0, lengths, np.inf)
    typical = np.where(typical > 0, typical, 1.0)
    coefficients = np.where(known[positive] > 0, known[positive], UNKNOWN_SHARE * typical[positive])
    factors = np.array([_upper_factor(pseudo_inertia(body)) for body in bodies]).reshape(-1, 4, 4)

    def theta_of(x: dict[str, Array]) -> Array:
        relative = jax.vmap(_upper)(x["bodies"])
        roots = jnp.asarray(factors) @ relative
        inertias = jax.vmap(lambda root: body_of_pseudo_inertia(root @ root.T))(roots)
        theta = jnp.zeros(len(kinds))
        theta = theta.at[inertial].set(inertias)
        theta = theta.at[positive].set(coefficients * jnp.exp(x["coefficients"]))
        return theta.at[signed].set(known[signed] + typical[signed] * x["signed"])

    A, b = jnp.asarray(triangle[:, :-1]), jnp.asarray(triangle[:, -1])

    def residual(x: dict[str, Array], _: Array) -> Array:
        departure = jax.vmap(_divergence_roots)(x["bodies"]).ravel()
        changes = jnp.sqrt(0.5) * x["coefficients"]
        return jnp.concatenate([A @ theta_of(x) - b, jnp.sqrt(regularisation) * jnp.concatenate([departure, changes])])

    with jax.enable_x64(True):
        start: dict[str, Any] = {
            "bodies": jnp.zeros((len(bodies), 10)),
            "coefficients": jnp.zeros(len(positive)),
            "signed": jnp.zeros(len(signed)),
        }
        once = (jnp.zeros(1),)  # one sample, with all residuals
        solve = jax.jit(
            lambda state: levenberg_marquardt.run(residual, state, once, iterations, improvement=improvement),
            compiler_options=quick_compilation(),
        )
        state = solve(levenberg_marquardt.init(start))
        theta = np.asarray(theta_of(state.parameters))
        roots = jax.vmap(_divergence_roots)(state.parameters["bodies"])
    return ConsistentFit(
        theta,
        np.sum(np.asarray(roots) ** 2, axis=1),
        int(state.iteration),
        levenberg_marquardt.Status(int(state.status)),
    )


def _upper_factor(J: np.ndarray) -> np.ndarray:
    """L upper triangular with J = L Lᵀ."""
    return np.linalg.cholesky(J[::-1, ::-1])[::-1, ::-1]


def _upper(numbers: Array) -> Array:
    """E [4, 4] of ten numbers."""
    return jnp.diag(jnp.exp(numbers[:4])).at[_ABOVE].set(numbers[4:])


def _divergence_roots(numbers: Array) -> Array:
    """Ten numbers whose squares sum to tr(E Eᵀ) - log det(E Eᵀ) - 4."""
    a = numbers[:4]
    near = jnp.abs(a) < 1e-3
    away = jnp.where(near, 1.0, a)
    series = jnp.sqrt(2.0) * a * (1 + a / 3 + a**2 / 9)
    roots = jnp.where(near, series, jnp.sign(a) * jnp.sqrt(jnp.expm1(2 * away) - 2 * away))
    return jnp.concatenate([roots, numbers[4:]])
