"""Hamilton's equations of natural systems with a factor of the inverse mass matrix, for one state.

    H = ½ |Lᵀ p|² + V(q),   M⁻¹ = L Lᵀ

In coordinates and velocities they take triangular solves with the factor, where a general Hamiltonian
(`mechanics.hamiltonian`) takes a Newton iteration for the momentum. An absent potential is `None`.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp

from dln_jax.mechanics.dynamics import Decomposition, Dynamics, friction_force, make_dynamics, plus_potential
from dln_jax.solvers.elimination import solve_lower, solve_lower_transposed
from dln_jax.types import CholeskyFactor, Dissipation, Hamiltonian, Potential, Scalar, Vector


class NaturalHamiltonian(NamedTuple):
    """Energies of a natural system with a factor of the inverse mass matrix, T = ½ |Lᵀ p|² with M⁻¹ = L Lᵀ."""

    inverse_factor: CholeskyFactor
    """q -> lower triangular L [d, d] with M⁻¹ = L Lᵀ."""
    potential: Potential | None = None
    """q -> V, scalar."""
    dissipation: Dissipation | None = None
    """(q, qd) -> Rayleigh function D, scalar."""


def hamiltonian(system: NaturalHamiltonian) -> Hamiltonian:
    """H(q, p) = ½ |Lᵀ p|² + V(q): no solve."""
    return lambda q, p: plus_potential(0.5 * jnp.sum((system.inverse_factor(q).T @ p) ** 2), system.potential, q)


def dynamics(system: NaturalHamiltonian, *, degrees_of_freedom: int | None = None) -> Dynamics:
    """Returns all functions of the system, by triangular solves with the factor.

    With `degrees_of_freedom` they refuse states of another size.

    With y = L⁻¹ qd, p = L⁻ᵀ y: qdd = dL/dt y + L (dL/dtᵀ p + Lᵀ dp/dt), and dT/dq_k = pᵀ dL/dq_k y.
    """

    def motion(q: Vector, qd: Vector):
        """L, dL/dt y, dL/dtᵀ p and dT/dq."""
        factor, factor_rate = jax.jvp(system.inverse_factor, (q,), (qd,))
        _, pull_back = jax.vjp(system.inverse_factor, q)
        y = solve_lower(factor, qd)
        p = solve_lower_transposed(factor, y)
        return factor, factor_rate @ y, factor_rate.T @ p, pull_back(jnp.outer(p, y))[0]

    def kinetic_force(q: Vector, qd: Vector, qdd: Vector) -> Vector:
        factor, drift, momentum_drift, slope = motion(q, qd)
        return solve_lower_transposed(factor, solve_lower(factor, qdd - drift) - momentum_drift) + slope

    def load(q: Vector, qd: Vector) -> Vector:
        """Contribution of potential and friction to tau."""
        force = jnp.zeros_like(q) if system.potential is None else jax.grad(system.potential)(q)
        return force if system.dissipation is None else force + friction_force(system.dissipation, q, qd)

    def accelerate(q: Vector, qd: Vector, tau: Vector) -> Vector:
        factor, drift, momentum_drift, slope = motion(q, qd)
        return drift + factor @ (momentum_drift + factor.T @ (tau - load(q, qd) - slope))

    def mass_times(q: Vector, vector: Vector) -> Vector:
        factor = system.inverse_factor(q)
        return solve_lower_transposed(factor, solve_lower(factor, vector))

    def energy(q: Vector, qd: Vector) -> Scalar:
        return plus_potential(0.5 * jnp.sum(solve_lower(system.inverse_factor(q), qd) ** 2), system.potential, q)

    def decompose(q: Vector, qd: Vector, qdd: Vector) -> Decomposition:
        return Decomposition(
            inertial=mass_times(q, qdd),
            coriolis=kinetic_force(q, qd, jnp.zeros_like(qd)),
            gravity=jnp.zeros_like(q) if system.potential is None else jax.grad(system.potential)(q),
        )

    return make_dynamics(
        lambda q, qd, qdd: kinetic_force(q, qd, qdd) + load(q, qd),
        accelerate,
        decompose,
        energy,
        lambda q, qd: jax.vmap(partial(mass_times, q))(jnp.eye(q.shape[0], dtype=q.dtype)),
        dissipation=system.dissipation,
        degrees_of_freedom=degrees_of_freedom,
    )
