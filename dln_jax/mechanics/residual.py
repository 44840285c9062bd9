"""What a known system leaves unexplained, as energies beside its own, for one state.

    tau = tau_known + d/dt dT/dqd - dT/dq + dV/dq + dD/dqd,   T = ½ |Lᵀ qd|²

A potential explains what repeats with the position (springs, cables, the teeth of gears), a Rayleigh function what
depends on the velocity too, and a kinetic energy, which only adds inertia, what is not rigid.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from dln_jax.mechanics import natural
from dln_jax.mechanics.dynamics import plus_potential
from dln_jax.mechanics.joint_friction import with_friction
from dln_jax.mechanics.loaded import LoadedSystem
from dln_jax.mechanics.natural import NaturalSystem
from dln_jax.mechanics.recursive import RecursiveSystem
from dln_jax.types import CholeskyFactor, Dissipation, Potential, Vector


class Residual(NamedTuple):
    """Energies beside those of a system; `None` for what is not there."""

    potential: Potential | None = None
    """q -> V, scalar."""
    dissipation: Dissipation | None = None
    """(q, qd) -> D, scalar; where it corrects friction that is there, it may be negative."""
    cholesky: CholeskyFactor | None = None
    """q -> lower triangular L [d, d]."""


def with_residual(system: RecursiveSystem | LoadedSystem, residual: Residual) -> RecursiveSystem | LoadedSystem:
    """The system with these energies added to its own; behind the transmission, where load counts."""
    if isinstance(system, LoadedSystem):
        behind = with_residual(system.link, residual._replace(dissipation=None))
        return with_friction(system._replace(link=behind), residual.dissipation)
    if residual.potential is not None:
        system = _with_potential(system, residual.potential)
    if residual.cholesky is not None:
        system = _with_inertia(system, NaturalSystem(residual.cholesky))
    return with_friction(system, residual.dissipation)


def _with_potential(system: RecursiveSystem, V: Potential) -> RecursiveSystem:
    return system._replace(
        forces=_plus(system.forces, lambda q, qd, qdd: jax.grad(V)(q)),
        potential=lambda q: plus_potential(V(q), system.potential, q),
    )


def _with_inertia(system: RecursiveSystem, moving: NaturalSystem) -> RecursiveSystem:
    return system._replace(
        mass_matrix=lambda q: system.mass_matrix(q) + natural.mass_matrix(moving, q),
        forces=_plus(system.forces, lambda *state: natural.inverse_dynamics(moving, *state)),
    )


def _plus(first: Callable[..., Array], second: Callable[..., Array]) -> Callable[[Vector, Vector, Vector], Vector]:
    return lambda q, qd, qdd: jnp.add(first(q, qd, qdd), second(q, qd, qdd))
