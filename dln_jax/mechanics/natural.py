"""Equations of motion of natural systems with a factor of the mass matrix or of its inverse, for one state.

    tau = M qdd + dM/dt qd - dT/dq + dV/dq

`NaturalSystem` has T = ½ |Lᵀ qd|² with M = L Lᵀ, `NaturalHamiltonian` T = ½ |Lᵀ p|² with M⁻¹ = L Lᵀ. The factor makes M
definite by construction and gives the momentum without a derivative or a Newton iteration; only triangular systems are
solved. An absent potential is `None` and is never traced.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp

from dln_jax.mechanics.dynamics import Decomposition, Functions, minus_potential, plus_potential
from dln_jax.solvers.elimination import solve_lower, solve_lower_transposed
from dln_jax.types import CholeskyFactor, Dissipation, Hamiltonian, Lagrangian, Matrix, Potential, Scalar, Vector


class NaturalSystem(NamedTuple):
    """Energies of a natural system with a factor of the mass matrix, as functions of one state.

    The Lagrangian is ½ |Lᵀ qd|² - V(q) with the mass matrix M = L Lᵀ, which is definite if the diagonal of L has no
    zero (Lutter, Ritter and Peters 2019). `dynamics` returns its equations of motion. All units are SI.

    Example:
        >>> import jax.numpy as jnp
        >>> import dln_jax
        >>> arm = dln_jax.NaturalSystem(lambda q: jnp.sqrt(jnp.array([[2.0]])), lambda q: 19.62 * jnp.sin(q[0]))
        >>> print(dln_jax.dynamics(arm).inverse_dynamics([0.5], [1.0], [2.0]).round(2))  # 2 qdd + 19.62 cos q, N m
        [21.22]
    """

    cholesky: CholeskyFactor
    """q -> lower triangular L [d, d], M = L Lᵀ."""
    potential: Potential | None = None
    """q -> V, scalar."""
    dissipation: Dissipation | None = None
    """(q, qd) -> Rayleigh function D, scalar."""


class NaturalHamiltonian(NamedTuple):
    """Energies of a natural system with a factor of the inverse mass matrix, as functions of one state.

    The Hamiltonian is ½ |Lᵀ p|² + V(q) with M⁻¹ = L Lᵀ. Compared with `HamiltonianSystem`, the momentum of a velocity
    takes two triangular solves and no Newton iteration. All units are SI.

    Example:
        >>> import jax.numpy as jnp
        >>> import dln_jax
        >>> arm = dln_jax.NaturalHamiltonian(lambda q: jnp.sqrt(jnp.array([[0.5]])), lambda q: 19.62 * jnp.sin(q[0]))
        >>> qd, pd = dln_jax.flow(arm).rates([0.5], [2.0])  # p / 2 in 1/s, -19.62 cos q in N m
        >>> print(qd.round(2), pd.round(2))
        [1.] [-17.22]
    """

    inverse_factor: CholeskyFactor
    """q -> lower triangular L [d, d], M⁻¹ = L Lᵀ."""
    potential: Potential | None = None
    """q -> V, scalar."""
    dissipation: Dissipation | None = None
    """(q, qd) -> Rayleigh function D, scalar."""


def lagrangian(system: NaturalSystem) -> Lagrangian:
    """Returns L(q, qd) = ½ |Lᵀ qd|² - V(q), for the generic functions of `mechanics.lagrangian`."""
    return lambda q, qd: minus_potential(_half_square(system.cholesky(q).T @ qd), system.potential, q)


def hamiltonian(system: NaturalSystem | NaturalHamiltonian) -> Hamiltonian:
    """Returns H(q, p) = T + V: ½ |L⁻¹ p|² + V(q) with the factor of M, ½ |Lᵀ p|² + V(q) with the factor of M⁻¹."""
    if isinstance(system, NaturalHamiltonian):
        return lambda q, p: plus_potential(_half_square(system.inverse_factor(q).T @ p), system.potential, q)
    return lambda q, p: plus_potential(_half_square(solve_lower(system.cholesky(q), p)), system.potential, q)


def mass_matrix(system: NaturalSystem, q: Vector) -> Matrix:
    """Returns the mass matrix M = L Lᵀ [d, d]."""
    factor = system.cholesky(q)
    return factor @ factor.T


def forces(system: NaturalSystem, q: Vector, qd: Vector, qdd: Vector) -> Vector:
    """Returns the generalised force tau [d] of a motion, without friction.

    With y = Lᵀ qd: dp/dt = L (Lᵀ qdd + dL/dtᵀ qd) + dL/dt y, and dT/dq_k = qdᵀ dL/dq_k y.
    """
    # One derivative of the factor along the motion and one pull-back instead of its d partial derivatives: faster to
    # train through for d >= 2. With one coordinate a single derivative gives both.
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
    return tau if system.potential is None else tau + jax.grad(system.potential)(q)


def functions(system: NaturalSystem) -> Functions:
    """Returns the functions of the system; two triangular solves with the factor give the forward model."""

    def accelerate(q: Vector, qd: Vector, tau: Vector) -> Vector:
        bias, factor = forces(system, q, qd, jnp.zeros_like(qd)), system.cholesky(q)
        return solve_lower_transposed(factor, solve_lower(factor, tau - bias))

    def decompose(q: Vector, qd: Vector, qdd: Vector) -> Decomposition:
        return Decomposition(
            inertial=mass_matrix(system, q) @ qdd,
            coriolis=forces(NaturalSystem(system.cholesky), q, qd, jnp.zeros_like(qd)),
            gravity=_gravity(system.potential, q),
        )

    def energy(q: Vector, qd: Vector) -> Scalar:
        return plus_potential(_half_square(system.cholesky(q).T @ qd), system.potential, q)

    return partial(forces, system), accelerate, energy, lambda q, qd: mass_matrix(system, q), decompose


def canonical_functions(system: NaturalHamiltonian) -> Functions:
    """Returns the functions of the system in coordinates and velocities.

    With y = L⁻¹ qd, p = L⁻ᵀ y: qdd = dL/dt y + L (dL/dtᵀ p + Lᵀ dp/dt), and dT/dq_k = pᵀ dL/dq_k y.
    """

    def motion(q: Vector, qd: Vector):
        """Returns L, dL/dt y, dL/dtᵀ p and dT/dq."""
        factor, factor_rate = jax.jvp(system.inverse_factor, (q,), (qd,))
        _, pull_back = jax.vjp(system.inverse_factor, q)
        y = solve_lower(factor, qd)
        p = solve_lower_transposed(factor, y)
        return factor, factor_rate @ y, factor_rate.T @ p, pull_back(jnp.outer(p, y))[0]

    def kinetic_force(q: Vector, qd: Vector, qdd: Vector) -> Vector:
        factor, drift, momentum_drift, slope = motion(q, qd)
        return solve_lower_transposed(factor, solve_lower(factor, qdd - drift) - momentum_drift) + slope

    def accelerate(q: Vector, qd: Vector, tau: Vector) -> Vector:
        factor, drift, momentum_drift, slope = motion(q, qd)
        driving = tau if system.potential is None else tau - jax.grad(system.potential)(q)
        return drift + factor @ (momentum_drift + factor.T @ (driving - slope))

    def mass_times(q: Vector, vector: Vector) -> Vector:
        factor = system.inverse_factor(q)
        return solve_lower_transposed(factor, solve_lower(factor, vector))

    def decompose(q: Vector, qd: Vector, qdd: Vector) -> Decomposition:
        coriolis = kinetic_force(q, qd, jnp.zeros_like(qd))
        return Decomposition(mass_times(q, qdd), coriolis, _gravity(system.potential, q))

    def tau(q: Vector, qd: Vector, qdd: Vector) -> Vector:
        force = kinetic_force(q, qd, qdd)
        return force if system.potential is None else force + jax.grad(system.potential)(q)

    def energy(q: Vector, qd: Vector) -> Scalar:
        return plus_potential(_half_square(solve_lower(system.inverse_factor(q), qd)), system.potential, q)

    def mass_matrix(q: Vector, qd: Vector) -> Matrix:
        return jax.vmap(partial(mass_times, q))(jnp.eye(q.shape[0], dtype=q.dtype))

    return tau, accelerate, energy, mass_matrix, decompose


def _half_square(vector: Vector) -> Scalar:
    return 0.5 * jnp.sum(vector**2)


def _gravity(V: Potential | None, q: Vector) -> Vector:
    return jnp.zeros_like(q) if V is None else jax.grad(V)(q)
