"""Equations of motion of natural systems, T = ½ qdᵀ M(q) qd with M = L Lᵀ and a Cholesky factor L.

    tau = M qdd + dM/dt qd - dT/dq + dV/dq

The factor makes M definite by construction, gives the momentum without a derivative, and turns the forward model
into two triangular solves. An absent potential is `None` and is never traced.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp

from dln_jax.mechanics.dynamics import (
    Decomposition,
    Dynamics,
    friction_force,
    make_dynamics,
    minus_potential,
    plus_potential,
)
from dln_jax.solvers.elimination import solve_lower, solve_lower_transposed
from dln_jax.types import CholeskyFactor, Dissipation, Hamiltonian, Lagrangian, Matrix, Potential, Scalar, Vector


class NaturalSystem(NamedTuple):
    """Energies of a natural system, as functions of one state."""

    cholesky: CholeskyFactor
    """q -> lower triangular L [d, d], M = L Lᵀ."""
    potential: Potential | None = None
    """q -> V, scalar."""
    dissipation: Dissipation | None = None
    """(q, qd) -> Rayleigh function D, scalar."""


def lagrangian(system: NaturalSystem) -> Lagrangian:
    """L(q, qd) = ½ |Lᵀ qd|² - V(q), for the generic functions of `mechanics.lagrangian`."""
    return lambda q, qd: minus_potential(_kinetic(system.cholesky(q), qd), system.potential, q)


def hamiltonian(system: NaturalSystem) -> Hamiltonian:
    """H(q, p) = ½ |L⁻¹ p|² + V(q) of a natural system with M = L Lᵀ."""
    return lambda q, p: plus_potential(0.5 * jnp.sum(solve_lower(system.cholesky(q), p) ** 2), system.potential, q)


def energy(system: NaturalSystem, q: Vector, qd: Vector) -> Scalar:
    """Energy T + V."""
    return plus_potential(_kinetic(system.cholesky(q), qd), system.potential, q)


def mass_matrix(system: NaturalSystem, q: Vector, qd: Vector | None = None) -> Matrix:
    """Mass matrix M = L Lᵀ [d, d]; the velocity is accepted but not used."""
    factor = system.cholesky(q)
    return factor @ factor.T


def inverse_dynamics(system: NaturalSystem, q: Vector, qd: Vector, qdd: Vector) -> Vector:
    """Generalised force tau [d] of a motion, friction included.

    With y = Lᵀ qd: dp/dt = L (Lᵀ qdd + dL/dtᵀ qd) + dL/dt y, and dT/dq_k = qdᵀ dL/dq_k y.
    """
    # One derivative of the factor along the motion and one pull-back, instead of all of its d partial derivatives:
    # faster to train through for d >= 2. With one coordinate a single derivative gives both.
    if q.shape[0] == 1:
        factor, slope = jax.jvp(system.cholesky, (q,), (jnp.ones_like(q),))
        factor_rate = slope * qd
        kinetic_force = jnp.sum(slope * jnp.outer(qd, factor.T @ qd), keepdims=True)[0]
    else:
        factor, factor_rate = jax.jvp(system.cholesky, (q,), (qd,))
        _, pull_back = jax.vjp(system.cholesky, q)
        (kinetic_force,) = pull_back(jnp.outer(qd, factor.T @ qd))
    momentum_rate = factor @ (factor.T @ qdd + factor_rate.T @ qd) + factor_rate @ (factor.T @ qd)
    tau = momentum_rate - kinetic_force
    if system.potential is not None:
        tau += jax.grad(system.potential)(q)
    return tau if system.dissipation is None else tau + friction_force(system.dissipation, q, qd)


def forward_dynamics(system: NaturalSystem, q: Vector, qd: Vector, tau: Vector) -> Vector:
    """Acceleration qdd [d] under a generalised force, by two triangular solves with the factor."""
    bias = inverse_dynamics(system, q, qd, jnp.zeros_like(qd))
    factor = system.cholesky(q)
    return solve_lower_transposed(factor, solve_lower(factor, tau - bias))


def decompose(system: NaturalSystem, q: Vector, qd: Vector, qdd: Vector) -> Decomposition:
    """Inertial M qdd, Coriolis dM/dt qd - dT/dq and gravity dV/dq, all [d]."""
    inertial_only = NaturalSystem(system.cholesky)
    return Decomposition(
        inertial=mass_matrix(system, q) @ qdd,
        coriolis=inverse_dynamics(inertial_only, q, qd, jnp.zeros_like(qd)),
        gravity=jnp.zeros_like(q) if system.potential is None else jax.grad(system.potential)(q),
    )


def dynamics(system: NaturalSystem, *, degrees_of_freedom: int | None = None) -> Dynamics:
    """Returns all functions of the system; with `degrees_of_freedom` they refuse states of another size."""
    return make_dynamics(
        partial(inverse_dynamics, system),
        partial(forward_dynamics, system),
        partial(decompose, system),
        partial(energy, system),
        partial(mass_matrix, system),
        dissipation=system.dissipation,
        degrees_of_freedom=degrees_of_freedom,
    )


def _kinetic(factor: Matrix, qd: Vector) -> Scalar:
    return 0.5 * jnp.sum((factor.T @ qd) ** 2)
