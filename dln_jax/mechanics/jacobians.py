"""Jacobians of the equations of motion for one state, computed as the kind of system allows at least cost.

For a natural system, tau = M qdd + c + g + dD/dqd with p = M(q) qd and A = dp/dq,

    dtau/dqdd = M,   dtau/dqd = dM/dt + A - Aᵀ + d²D/dqd²,   dtau/dq by d tangents of tau and p together

The second holds because the derivative of dL/dq = ½ d(qdᵀ M qd)/dq by qd is Aᵀ. No tangent of a velocity or an
acceleration is pushed through a network. For other systems all Jacobians come from one reverse sweep over d rows. The
forward model is the implicit function of the inverse one:

    dqdd/dq = -M⁻¹ dtau/dq,   dqdd/dqd = -M⁻¹ dtau/dqd,   dqdd/dtau = M⁻¹        at qdd

M⁻¹ is itself a result, so one factorisation gives it and the acceleration. Reverse sweeps differentiate the forward
models of Hamiltonians and of separate networks instead.
"""

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import Array

from dln_jax.mechanics.dynamics import InverseForward, friction_of
from dln_jax.mechanics.equations import Driven, Energies, dynamics
from dln_jax.mechanics.explicit import ExplicitSystem
from dln_jax.mechanics.hamiltonian import HamiltonianSystem
from dln_jax.mechanics.joint_friction import LoadedSystem
from dln_jax.mechanics.natural import NaturalHamiltonian, NaturalSystem
from dln_jax.solvers.elimination import solve, solve_lower
from dln_jax.types import Matrix, Vector

Natural = NaturalSystem | ExplicitSystem | NaturalHamiltonian
"""Energies with a mass matrix that depends on q alone."""
Jacobians = tuple[Array, Array, Array]
"""Derivatives [d, d] by three arguments; row i belongs to result i."""


def inverse_dynamics_jacobians(system: Driven, q: Vector, qd: Vector, qdd: Vector) -> Jacobians:
    """Returns dtau/dq, dtau/dqd and dtau/dqdd = M at a motion, including friction."""
    motion = dynamics(system)
    if not isinstance(system, Natural):
        return jax.jacrev(motion.inverse_dynamics, argnums=(0, 1, 2))(q, qd, qdd)
    tau_q, tau_qd, mass = _natural_jacobians(system, lambda q: motion.inverse_dynamics(q, qd, qdd), q, qd)
    if (friction := friction_of(system)) is not None:
        tau_qd += jax.jacfwd(friction, argnums=1)(q, qd)
    return tau_q, tau_qd, mass


def coriolis_jacobians(system: Driven, q: Vector, qd: Vector) -> tuple[Array, Array]:
    """Returns dc/dq and dc/dqd, both [d, d], of the Coriolis force of `decompose`."""
    decompose = dynamics(system).decompose

    def coriolis(q: Vector, qd: Vector) -> Vector:
        return decompose(q, qd, jnp.zeros_like(q)).coriolis

    if not isinstance(system, Natural):
        return jax.jacrev(coriolis, argnums=(0, 1))(q, qd)
    return _natural_jacobians(system, lambda q: coriolis(q, qd), q, qd)[:2]


def forward_dynamics_jacobians(system: Driven, q: Vector, qd: Vector, tau: Vector) -> tuple[Vector, Jacobians]:
    """Returns qdd [d] under a generalised force, with dqdd/dq, dqdd/dqd and dqdd/dtau = M⁻¹ there."""
    motion = dynamics(system)
    if isinstance(system, HamiltonianSystem | LoadedSystem | InverseForward):

        def accelerate(*state: Vector) -> tuple[Vector, Vector]:
            qdd = motion.forward_dynamics(*state)
            return qdd, qdd

        jacobians, qdd = jax.jacrev(accelerate, argnums=(0, 1, 2), has_aux=True)(q, qd, tau)
        return qdd, jacobians
    inverse_mass = _inverse_mass(system, q, qd)
    qdd = inverse_mass @ (tau - motion.inverse_dynamics(q, qd, jnp.zeros_like(qd)))
    tau_q, tau_qd, _ = inverse_dynamics_jacobians(system, q, qd, qdd)
    return qdd, (-inverse_mass @ tau_q, -inverse_mass @ tau_qd, inverse_mass)


def differentiable_forward_dynamics(
    system: Driven, *, degrees_of_freedom: int
) -> tuple[Callable[..., Array], Callable[..., tuple[Vector, Jacobians]]]:
    """Returns (q, qd, tau) -> qdd [d], differentiated by its Jacobians, and `forward_dynamics_jacobians`.

    Derivatives in many directions, such as those of a step by its whole state, then share one Jacobian. Both functions
    are jitted: a step that calls them several times traces, compiles and exports them once.
    """
    forward_dynamics = jax.custom_jvp(jax.jit(dynamics(system, degrees_of_freedom=degrees_of_freedom).forward_dynamics))
    jacobians = jax.jit(functools.partial(forward_dynamics_jacobians, system))

    @forward_dynamics.defjvp
    def rule(state: tuple[Array, ...], tangents: tuple[Array, ...]) -> tuple[Array, Array]:
        qdd, (by_q, by_qd, by_tau) = jacobians(*state)
        q_dot, qd_dot, tau_dot = tangents
        return qdd, by_q @ q_dot + by_qd @ qd_dot + by_tau @ tau_dot

    return forward_dynamics, jacobians


def _natural_jacobians(system: Natural, force: Callable[[Vector], Vector], q: Vector, qd: Vector) -> Jacobians:
    """Returns the derivatives of a force by q and of the Coriolis force by qd, and M."""
    mass_matrix = dynamics(system).mass_matrix

    def force_and_momentum(q: Vector) -> tuple[Vector, Vector]:
        return force(q), _momentum(system, q, qd)

    # Together, because both push the same tangents through the mass matrix.
    force_q, momentum_q = jax.jacfwd(force_and_momentum)(q)
    mass, mass_rate = jax.jvp(mass_matrix, (q,), (qd,))
    return force_q, mass_rate + momentum_q - momentum_q.T, mass


def _momentum(system: Natural, q: Vector, qd: Vector) -> Vector:
    if isinstance(system, NaturalSystem):
        factor = system.cholesky(q)
        return factor @ (factor.T @ qd)  # two small products; M would take a large one
    if isinstance(system, NaturalHamiltonian):
        return dynamics(system).decompose(q, jnp.zeros_like(qd), qd).inertial
    return system.mass_matrix(q) @ qd


def _inverse_mass(system: Energies, q: Vector, qd: Vector) -> Matrix:
    identity = jnp.eye(q.shape[0], dtype=q.dtype)
    if isinstance(system, NaturalHamiltonian):
        factor = system.inverse_factor(q)
        return factor @ factor.T
    if isinstance(system, NaturalSystem):
        factor = system.cholesky(q)
        columns = jax.vmap(lambda column: solve_lower(factor, column))(identity)
        return columns @ columns.T
    return solve(dynamics(system).mass_matrix(q, qd), identity)
