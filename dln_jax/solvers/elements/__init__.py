"""Minimises sums of element energies, and solves the linear systems of its Newton steps."""

from dln_jax.solvers.elements.assembly import Pattern, pattern
from dln_jax.solvers.elements.energies import ElementEnergy, value
from dln_jax.solvers.elements.linear_solvers import LinearSolver, block_tridiagonal, dense, matrix_free, sparse
from dln_jax.solvers.elements.minimise import minimise
from dln_jax.solvers.elements.selection import by_size, by_stiffness

__all__ = [
    "ElementEnergy",
    "LinearSolver",
    "Pattern",
    "block_tridiagonal",
    "by_size",
    "by_stiffness",
    "dense",
    "matrix_free",
    "minimise",
    "pattern",
    "sparse",
    "value",
]
