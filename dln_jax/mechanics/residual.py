"""Corrections of a known system by additional energies, for one state.

    tau = tau_known + d/dt dT/dqd - dT/dq + dV/dq + dD/dqd,   T = ½ |Lᵀ qd|²

A potential explains forces that depend on the position (springs, cables, gear teeth). A Rayleigh function explains
forces that also depend on the velocity. A kinetic energy, which can only add inertia, explains flexible parts.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from dln_jax.mechanics import natural
from dln_jax.mechanics.dynamics import minus_potential
from dln_jax.mechanics.explicit import ExplicitSystem
from dln_jax.mechanics.joint_friction import LoadedSystem, sum_of, with_friction
from dln_jax.mechanics.lagrangian import LagrangianSystem
from dln_jax.mechanics.natural import NaturalSystem
from dln_jax.types import CholeskyFactor, Dissipation, Potential, Scalar, Vector


class Residual(NamedTuple):
    """Energies added to a system; `None` for absent terms."""

    potential: Potential | None = None
    """q -> V, scalar."""
    dissipation: Dissipation | None = None
    """(q, qd) -> D, scalar; may be negative if it corrects existing friction."""
    cholesky: CholeskyFactor | None = None
    """q -> lower triangular L [d, d]."""


def with_residual(system: Any, residual: Residual) -> ExplicitSystem | LagrangianSystem | LoadedSystem:
    """Adds energies to a system.

    In a `LoadedSystem`, potential and inertia are added behind the transmission, and dissipation before it.

    Args:
        system: a natural system, a Lagrangian, or a `LoadedSystem` of one.
    """
    V, D, factor = residual
    if isinstance(system, LoadedSystem):
        link = with_residual(system.link, residual._replace(dissipation=None))
        return with_friction(system._replace(link=link), D)
    if isinstance(system, LagrangianSystem):

        def lagrangian(q: Vector, qd: Vector) -> Scalar:
            L = minus_potential(system.lagrangian(q, qd), V, q)
            return L if factor is None else L + 0.5 * jnp.sum((factor(q).T @ qd) ** 2)

        return with_friction(system._replace(lagrangian=lagrangian), D)
    if isinstance(system, NaturalSystem):
        parts = partial(natural.mass_matrix, system), partial(natural.forces, system)
        system = ExplicitSystem(*parts, system.potential, system.dissipation)
    system = system._replace(decompose=None)
    if V is not None:
        forces = sum_of(system.forces, lambda q, qd, qdd: jax.grad(V)(q))
        system = system._replace(forces=forces, potential=sum_of(system.potential, V))
    if factor is not None:
        moving = NaturalSystem(factor)
        system = system._replace(
            mass_matrix=sum_of(system.mass_matrix, partial(natural.mass_matrix, moving)),
            forces=sum_of(system.forces, partial(natural.forces, moving)),
        )
    return with_friction(system, D)
