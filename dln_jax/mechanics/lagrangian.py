"""Equations of motion of any Lagrangian L(q, qd), for one state.

    d/dt dL/dqd - dL/dq = tau        (Euler-Lagrange)

The inverse model is one `jvp` of the gradient. The forward model also solves a linear system with the Hessian by qd.
Nothing is regularised: a singular mass matrix gives non-finite accelerations.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp

from dln_jax.mechanics.arguments import require_size_of
from dln_jax.mechanics.dynamics import Functions, decompose_by_differences
from dln_jax.solvers.elimination import solve
from dln_jax.types import Dissipation, Lagrangian, Matrix, Scalar, Vector


class LagrangianSystem(NamedTuple):
    """Energies of any Lagrangian system, as functions of one state.

    `dynamics` returns the equations d/dt dL/dqd - dL/dq + dD/dqd = tau (Euler-Lagrange, with a Rayleigh function D). A
    singular mass matrix d²L/dqd² gives non-finite accelerations. All vectors are [d], in SI units.

    Example:
        >>> import jax.numpy as jnp
        >>> import dln_jax
        >>> pendulum = dln_jax.LagrangianSystem(lambda q, qd: 0.5 * qd[0] ** 2 + 9.81 * jnp.cos(q[0]))
        >>> acceleration = dln_jax.dynamics(pendulum).forward_dynamics([0.5], [0.0], [1.0])  # tau - 9.81 sin q
        >>> print(f"{acceleration[0]:.3f} 1/s²")
        -3.703 1/s²
    """

    lagrangian: Lagrangian
    """(q, qd) -> L, scalar."""
    dissipation: Dissipation | None = None
    """(q, qd) -> Rayleigh function D, scalar; `None` without friction."""


def momentum(L: Lagrangian, q: Vector, qd: Vector) -> Vector:
    """Returns the generalised momentum p = dL/dqd [d]."""
    return jax.grad(L, argnums=1)(q, qd)


def energy(L: Lagrangian, q: Vector, qd: Vector) -> Scalar:
    """Returns the energy E = qdᵀ dL/dqd - L, which is T + V for a natural system."""
    lagrangian, rate = jax.jvp(lambda velocity: L(q, velocity), (qd,), (qd,))
    return rate - lagrangian


def mass_matrix(L: Lagrangian, q: Vector, qd: Vector) -> Matrix:
    """Returns the mass matrix M = d²L/dqd² [d, d]: symmetric, but definite only if the Lagrangian makes it so."""
    return jax.jacfwd(lambda velocity: momentum(L, q, velocity))(qd)


def inverse_dynamics(L: Lagrangian, q: Vector, qd: Vector, qdd: Vector) -> Vector:
    """Returns the generalised force tau = d/dt dL/dqd - dL/dq [d] of a motion."""
    # One gradient for force and momentum together shares a reverse sweep: two thirds of the work of a Jacobian.
    (force, _), (_, momentum_rate) = jax.jvp(jax.grad(L, argnums=(0, 1)), (q, qd), (qd, qdd))
    return momentum_rate - force


def forward_dynamics(L: Lagrangian, q: Vector, qd: Vector, tau: Vector) -> Vector:
    """Returns the acceleration qdd [d] under a generalised force: solves M qdd = tau - tau(q, qd, 0)."""
    bias = inverse_dynamics(L, q, qd, jnp.zeros_like(qd))
    return solve(mass_matrix(L, q, qd), tau - bias)


def functions(system: LagrangianSystem, degrees_of_freedom: int | None) -> Functions:
    """Returns the functions of the system.

    Without `degrees_of_freedom`, they refuse states that are too short for L, and states with rates that L ignores.
    """
    accepted = {degrees_of_freedom}

    def L(q: Vector, qd: Vector) -> Scalar:
        size = q.shape[0]
        # Energies of models have a size, and refuse others themselves.
        if size not in accepted and not hasattr(system.lagrangian, "size"):
            require_size_of(system.lagrangian, size)
            accepted.add(size)
        return system.lagrangian(q, qd)

    force = partial(inverse_dynamics, L)
    decompose = partial(decompose_by_differences, force)
    return force, partial(forward_dynamics, L), partial(energy, L), partial(mass_matrix, L), decompose
