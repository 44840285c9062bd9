"""Equations of motion of any record of energies: `dynamics` in coordinates and velocities, `flow` in a phase space.

| record | energies | module |
|---|---|---|
| `NaturalSystem` | factor of M, V, D | `mechanics.natural` |
| `NaturalHamiltonian` | factor of M⁻¹, V, D | `mechanics.natural` |
| `ExplicitSystem` | M, V, D, and the resulting forces | `mechanics.explicit` |
| `LagrangianSystem` | L, D | `mechanics.lagrangian` |
| `HamiltonianSystem` | H, D | `mechanics.hamiltonian` |
| `LoadedSystem` | any of these, and load-dependent friction | `mechanics.joint_friction` |
| `InverseForward` | none: tau and qdd | `mechanics.dynamics` |
| `PhaseRates` | none: (qd, pd) | `mechanics.dynamics` |

All energies have both dynamics and flow; `InverseForward` has dynamics only, `PhaseRates` a flow only.
"""

from functools import partial
from typing import Any, overload

import jax.numpy as jnp

from dln_jax.mechanics import explicit, hamiltonian, lagrangian, natural
from dln_jax.mechanics.arguments import answer, vectors
from dln_jax.mechanics.dynamics import (
    Dynamics,
    Flow,
    InverseForward,
    PhaseRates,
    PlainDynamics,
    decompose_by_differences,
    friction_of,
    make_plain_dynamics,
)
from dln_jax.mechanics.explicit import ExplicitSystem
from dln_jax.mechanics.hamiltonian import HamiltonianSystem
from dln_jax.mechanics.joint_friction import LoadedSystem, link_force, loaded_dynamics
from dln_jax.mechanics.lagrangian import LagrangianSystem
from dln_jax.mechanics.natural import NaturalHamiltonian, NaturalSystem
from dln_jax.types import Hamiltonian, InputError, Vector

Canonical = NaturalHamiltonian | HamiltonianSystem
"""Energies in terms of momenta."""
Energies = NaturalSystem | ExplicitSystem | LagrangianSystem | Canonical | LoadedSystem
Driven = Energies | InverseForward
"""Systems with applied forces."""
System = Driven | PhaseRates


def _dynamics_of_loaded(system: LoadedSystem, *, degrees_of_freedom: int | None = None) -> Dynamics:
    link = dynamics(system.link, degrees_of_freedom=degrees_of_freedom)
    return loaded_dynamics(system, link, degrees_of_freedom=degrees_of_freedom)


def _dynamics_of_functions(system: InverseForward, *, degrees_of_freedom: int | None = None) -> PlainDynamics:
    # The decomposition takes differences of the inverse function, so friction counts as Coriolis force.
    decompose = partial(decompose_by_differences, system.inverse_dynamics)
    return make_plain_dynamics(*system, decompose, degrees_of_freedom=degrees_of_freedom)


_DYNAMICS: dict[type, Any] = {
    NaturalSystem: natural.dynamics,
    ExplicitSystem: explicit.dynamics,
    LagrangianSystem: lagrangian.dynamics,
    NaturalHamiltonian: natural.hamiltonian_dynamics,
    HamiltonianSystem: hamiltonian.dynamics,
    LoadedSystem: _dynamics_of_loaded,
    InverseForward: _dynamics_of_functions,
}


@overload
def dynamics(system: Energies, *, degrees_of_freedom: int | None = None) -> Dynamics: ...
@overload
def dynamics(system: InverseForward, *, degrees_of_freedom: int | None = None) -> PlainDynamics: ...
def dynamics(system: System, *, degrees_of_freedom: int | None = None) -> Dynamics | PlainDynamics:
    """Returns the functions of a system in coordinates and velocities.

    Args:
        system: a record of energies, or `InverseForward`.
        degrees_of_freedom: d; states of another size are refused. Without it, arguments need only agree in size.

    Raises:
        InputError: the system is the rates of a phase space, which do not define forces, or not a record.
    """
    make = _DYNAMICS.get(type(system))
    if make is None:
        hint = ": give model.energies(parameters)" if hasattr(system, "energies") else ""
        raise InputError(f"dynamics got a {type(system).__name__}{hint}; expected one of {_names(*_DYNAMICS)}")
    return make(system, degrees_of_freedom=degrees_of_freedom)


@overload
def flow(system: Energies, *, degrees_of_freedom: int | None = None) -> Flow: ...
@overload
def flow(system: PhaseRates, *, degrees_of_freedom: int | None = None) -> Flow | PhaseRates: ...
def flow(system: System, *, degrees_of_freedom: int | None = None) -> Flow | PhaseRates:
    """Returns the functions of a system in (q, p), without applied forces; arguments as for `dynamics`.

    Raises:
        InputError: the system is an `InverseForward`, which has no flow, or not a record.
    """
    d = degrees_of_freedom
    if isinstance(system, PhaseRates):
        rates, energy = system
        checked = PhaseRates(lambda q, p: answer(rates, *vectors(d, q=q, p=p)))
        if energy is None:
            return checked
        return Flow(checked.rates, lambda q, p: answer(energy, *vectors(d, q=q, p=p)))
    if not isinstance(system, Energies):
        known = [*_DYNAMICS, PhaseRates]
        known.remove(InverseForward)
        raise InputError(f"flow got a {type(system).__name__}; expected one of {_names(*known)}")
    H = hamiltonian_of(system)

    def hamilton(q, p):
        if isinstance(system, LoadedSystem):
            qd = hamiltonian.velocity(H, q, p)
            return hamiltonian.time_derivative(H, q, p, driving_force(system, q, qd, jnp.zeros_like(q)))
        return hamiltonian.time_derivative(H, q, p, jnp.zeros_like(q), dissipation=system.dissipation)

    return Flow(lambda q, p: answer(hamilton, *vectors(d, q=q, p=p)), lambda q, p: answer(H, *vectors(d, q=q, p=p)))


def driving_force(system: Energies, q: Vector, qd: Vector, tau: Vector) -> Vector:
    """Returns the generalised force [d] that is left to move the system after friction."""
    if isinstance(system, LoadedSystem):
        return link_force(system, q, qd, tau)
    force = friction_of(system)
    return tau if force is None else tau - force(q, qd)


def hamiltonian_of(system: Energies) -> Hamiltonian:
    """Returns H(q, p) of any energies; of a Lagrangian by the Legendre transform, in general by Newton's method."""
    match system:
        case HamiltonianSystem():
            return system.hamiltonian
        case NaturalHamiltonian() | NaturalSystem():
            return natural.hamiltonian(system)
        case ExplicitSystem():
            return hamiltonian.legendre(explicit.lagrangian(system), iterations=1)
        case LagrangianSystem():
            return hamiltonian.legendre(system.lagrangian)
        case LoadedSystem():
            return hamiltonian_of(system.link)


def _names(*types: type) -> str:
    return ", ".join(record.__name__ for record in types)
