"""Definiteness of mass matrices: a kinetic energy has a positive definite M, a black-box network may not."""

from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Float

from dln_jax.mechanics.dynamics import Dynamics, PlainDynamics
from dln_jax.types import InputError


class Definiteness(NamedTuple):
    """Eigenvalue statistics of the mass matrices of several states."""

    smallest_eigenvalue: float
    """Smallest over all states, in the unit of M; NaN if a matrix is not finite."""
    share_not_definite: float
    """Share of states, 0 to 1, whose M is indefinite, singular to rounding, or not finite."""
    largest_condition_number: float
    """Largest ratio of the eigenvalues' magnitudes; infinite if M is singular or not finite."""


def definiteness(
    dynamics: Dynamics | PlainDynamics, q: Float[Array | np.ndarray, "N d"], qd: Float[Array | np.ndarray, "N d"]
) -> Definiteness:
    """Evaluates the eigenvalues of the mass matrix at N states. It only reports; nothing is repaired.

    An eigenvalue counts as positive if it exceeds d times the rounding unit times the largest magnitude of its matrix.
    A Hamiltonian model has M = H_pp⁻¹, which is not finite where H_pp is singular.

    Raises:
        InputError: the model has no mass matrix, or there are no states.
    """
    if not isinstance(dynamics, Dynamics):
        raise InputError("definiteness: the model has no mass matrix; give one that comes from an energy")
    if len(q) == 0:
        raise InputError("definiteness: q has no states; give at least one row")
    masses = np.asarray(jax.jit(jax.vmap(dynamics.mass_matrix))(q, qd))
    rounding = masses.shape[-1] * np.finfo(masses.dtype).eps
    finite = np.isfinite(masses).all(axis=(1, 2))
    eigenvalues = np.full(masses.shape[:2], np.nan)
    symmetric = (masses[finite] + masses[finite].swapaxes(1, 2)) / 2
    eigenvalues[finite] = np.linalg.eigvalsh(symmetric.astype(np.float64))

    sizes = np.abs(eigenvalues)
    largest, smallest = sizes.max(axis=1), sizes.min(axis=1)
    definite = eigenvalues.min(axis=1) > rounding * largest
    regular = smallest > rounding * largest
    conditions = np.divide(largest, smallest, out=np.full_like(largest, np.inf), where=regular)
    return Definiteness(float(eigenvalues.min()), float(np.mean(~definite)), float(conditions.max()))
