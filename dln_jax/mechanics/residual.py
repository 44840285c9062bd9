"""Residual of a known system as additional energies, for one state.

    tau = tau_known + d/dt dT/dqd - dT/dq + dV/dq + dD/dqd,   T = ½ |Lᵀ qd|²

A potential explains forces that repeat with the position (springs, cables, gear teeth), a Rayleigh function forces that
also depend on the velocity, and a kinetic energy, which only adds inertia, flexible parts.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from dln_jax.mechanics import closed_form, natural
from dln_jax.mechanics.closed_form import ClosedForm, RecursiveSystem
from dln_jax.mechanics.dynamics import friction_of, minus_potential, plus_potential
from dln_jax.mechanics.joint_friction import LoadedSystem, with_friction
from dln_jax.mechanics.lagrangian import LagrangianSystem
from dln_jax.mechanics.natural import NaturalSystem
from dln_jax.types import CholeskyFactor, Dissipation, Lagrangian, Potential, Scalar, Vector


class Residual(NamedTuple):
    """Energies added to those of a system; `None` for absent ones."""

    potential: Potential | None = None
    """q -> V, scalar."""
    dissipation: Dissipation | None = None
    """(q, qd) -> D, scalar; it may be negative if it corrects existing friction."""
    cholesky: CholeskyFactor | None = None
    """q -> lower triangular L [d, d]."""


def with_residual(system: Any, residual: Residual) -> RecursiveSystem | LagrangianSystem | LoadedSystem:
    """Adds energies to those of a system.

    In a `LoadedSystem`, potential and inertia are added behind the transmission, and dissipation before it.

    Args:
        system: any record of a natural system, a Lagrangian, or one of them behind transmissions.
        residual: the added energies.
    """
    if isinstance(system, LoadedSystem):
        behind = with_residual(system.link, residual._replace(dissipation=None))
        return with_friction(system._replace(link=behind), residual.dissipation)
    if isinstance(system, LagrangianSystem):
        L = _sum(system.lagrangian, residual)
        return with_friction(system._replace(lagrangian=L), residual.dissipation)
    system = _recursive(system)
    if residual.potential is not None:
        system = _with_potential(system, residual.potential)
    if residual.cholesky is not None:
        system = _with_inertia(system, NaturalSystem(residual.cholesky))
    return with_friction(system, residual.dissipation)


def _sum(L: Lagrangian, residual: Residual) -> Lagrangian:
    def both(q: Vector, qd: Vector) -> Scalar:
        total = minus_potential(L(q, qd), residual.potential, q)
        return total if residual.cholesky is None else total + 0.5 * jnp.sum((residual.cholesky(q).T @ qd) ** 2)

    return both


def _recursive(system: RecursiveSystem | ClosedForm | NaturalSystem) -> RecursiveSystem:
    """Returns the same system as a recursive one."""
    if isinstance(system, RecursiveSystem):
        return system
    V, D, friction = system.potential, system.dissipation, friction_of(system)
    if isinstance(system, ClosedForm):
        return RecursiveSystem(system.mass_matrix, partial(closed_form.forces, system), V, D, friction)
    return RecursiveSystem(partial(natural.mass_matrix, system), partial(natural.forces, system), V, D, friction)


def _with_potential(system: RecursiveSystem, V: Potential) -> RecursiveSystem:
    return system._replace(
        forces=_plus(system.forces, lambda q, qd, qdd: jax.grad(V)(q)),
        potential=lambda q: plus_potential(V(q), system.potential, q),
    )


def _with_inertia(system: RecursiveSystem, moving: NaturalSystem) -> RecursiveSystem:
    return system._replace(
        mass_matrix=lambda q: system.mass_matrix(q) + natural.mass_matrix(moving, q),
        forces=_plus(system.forces, lambda *state: natural.forces(moving, *state)),
    )


def _plus(first: Callable[..., Array], second: Callable[..., Array]) -> Callable[[Vector, Vector, Vector], Vector]:
    return lambda q, qd, qdd: jnp.add(first(q, qd, qdd), second(q, qd, qdd))
