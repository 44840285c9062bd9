"""Adds friction of joints to any record of energies, or to a system without energy."""

from typing import Any

import jax.numpy as jnp
from jax import Array

from dln_jax.mechanics import loaded
from dln_jax.mechanics.closed_form import ClosedForm
from dln_jax.mechanics.dynamics import friction_force
from dln_jax.mechanics.loaded import Load, LoadedSystem
from dln_jax.mechanics.plain import InverseForward, PhaseRates
from dln_jax.mechanics.recursive import RecursiveSystem
from dln_jax.types import Dissipation, Scalar, Vector


def with_friction(system: Any, dissipation: Dissipation | None, load: Load | None = None) -> Any:
    """Returns the same system with friction in its joints, added to the friction that it has.

    A system without an energy keeps its kind: the force is added on its inverse side, and subtracted on its forward
    side and in its rates.

    Args:
        system: one of `mechanics.equations.System`.
        dissipation: (q, qd) -> Rayleigh function, as from `joint_dissipation`.
        load: friction of the transmissions by load; all other friction, the system's own too, is then before them.

    Returns:
        The record, or with a load a `LoadedSystem`.
    """
    if dissipation is None and load is None:
        return system
    if isinstance(system, InverseForward | PhaseRates):
        return _plain(system, LoadedSystem(None, load or Load(0.0), dissipation))
    if dissipation is not None:
        system = _dissipating(system, _sum(system.dissipation, dissipation))
    if load is None:
        return system
    return LoadedSystem(_dissipating(system, None), load, system.dissipation)


def _dissipating(system: Any, dissipation: Dissipation | None) -> Any:
    if not isinstance(system, ClosedForm | RecursiveSystem):
        return system._replace(dissipation=dissipation)
    force = None if dissipation is None else (lambda q, qd: friction_force(dissipation, q, qd))
    return system._replace(dissipation=dissipation, friction=force)


def _sum(first: Dissipation | None, second: Dissipation) -> Dissipation:
    if first is None:
        return second

    def both(q: Vector, qd: Vector) -> Scalar:
        return first(q, qd) + second(q, qd)

    return both


def _plain(system: InverseForward | PhaseRates, friction: LoadedSystem) -> InverseForward | PhaseRates:
    def before(q: Vector, qd: Vector, tau_link: Vector) -> Vector:
        tau = loaded.carrying(friction.load, qd, tau_link)
        return tau if friction.dissipation is None else tau + friction_force(friction.dissipation, q, qd)

    if isinstance(system, PhaseRates):

        def rates(q: Vector, p: Vector) -> tuple[Array, Array]:
            qd, pd = system.rates(q, p)
            return qd, pd + loaded.link_force(friction, q, qd, jnp.zeros_like(qd))

        return PhaseRates(rates)
    return InverseForward(
        lambda q, qd, qdd: before(q, qd, system.inverse_dynamics(q, qd, qdd)),
        lambda q, qd, tau: system.forward_dynamics(q, qd, loaded.link_force(friction, q, qd, tau)),
    )
