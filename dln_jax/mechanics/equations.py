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

from typing import Any, get_args, overload

import jax
import jax.numpy as jnp

from dln_jax.mechanics import explicit, hamiltonian, lagrangian, natural
from dln_jax.mechanics.arguments import answer, vectors
from dln_jax.mechanics.dynamics import (
    Dynamics,
    Flow,
    Functions,
    InverseForward,
    PhaseRates,
    friction_of,
)
from dln_jax.mechanics.explicit import ExplicitSystem
from dln_jax.mechanics.hamiltonian import HamiltonianSystem
from dln_jax.mechanics.joint_friction import LoadedSystem, carried, carrying, link_force
from dln_jax.mechanics.lagrangian import LagrangianSystem
from dln_jax.mechanics.natural import NaturalHamiltonian, NaturalSystem
from dln_jax.types import Hamiltonian, InputError, Vector

Canonical = NaturalHamiltonian | HamiltonianSystem
"""Energies in terms of momenta."""
Energies = NaturalSystem | ExplicitSystem | LagrangianSystem | Canonical | LoadedSystem
Driven = Energies | InverseForward
"""Systems with applied forces."""
System = Driven | PhaseRates


@overload
def dynamics(system: Energies, *, degrees_of_freedom: int | None = None) -> Dynamics: ...
@overload
def dynamics(system: InverseForward, *, degrees_of_freedom: int | None = None) -> InverseForward: ...
def dynamics(system: System, *, degrees_of_freedom: int | None = None) -> Dynamics | InverseForward:
    """Returns the functions of a system in coordinates and velocities.

    They solve tau = M(q) qdd + c(q, qd) + g(q) + dD/dqd for tau or for qdd, and return energy, mass matrix, torque
    components and friction. Each takes one state with vectors [d] in SI units; use `jax.vmap` for samples.

    Args:
        system: a record of energies, or `InverseForward`.
        degrees_of_freedom: d. The functions refuse states of another size. Without it, arguments need only agree in
            size.

    Raises:
        InputError: the system is a `PhaseRates`, which does not define forces, or not a record.

    Example:
        >>> import dln_jax
        >>> cart = dln_jax.dynamics(dln_jax.LagrangianSystem(lambda q, qd: 1.5 * qd @ qd - 2.0 * q @ q))
        >>> print(cart.inverse_dynamics([0.5], [0.0], [2.0]), cart.mass_matrix([0.5]))  # 3 qdd + 4 q in N, M in kg
        [8.] [[3.]]
    """
    d = degrees_of_freedom
    if not isinstance(system, Driven):
        hint = ": give model.energies(parameters)" if hasattr(system, "energies") else ""
        raise InputError(f"dynamics got a {type(system).__name__}{hint}; expected one of {_names(Driven)}")
    functions = system if isinstance(system, InverseForward) else _functions(system, d)
    inverse, forward = functions[:2]
    both = InverseForward(
        lambda q, qd, qdd: answer(inverse, *vectors(d, q=q, qd=qd, qdd=qdd)),
        lambda q, qd, tau: answer(forward, *vectors(d, q=q, qd=qd, tau=tau)),
    )
    if isinstance(functions, InverseForward):
        return both
    energy, mass_matrix, decompose = functions[2:]
    force = friction_of(system)

    def mass_matrix_or_at_rest(q, qd=None):
        if qd is None:
            (q,) = vectors(d, q=q)
            return answer(mass_matrix, q, jnp.zeros_like(q))
        return answer(mass_matrix, *vectors(d, q=q, qd=qd))

    def friction(q, qd):
        q, qd = vectors(d, q=q, qd=qd)
        return jnp.zeros_like(qd) if force is None else answer(force, q, qd)

    return Dynamics(
        *both,
        lambda q, qd: answer(energy, *vectors(d, q=q, qd=qd)),
        mass_matrix_or_at_rest,
        lambda q, qd, qdd: answer(decompose, *vectors(d, q=q, qd=qd, qdd=qdd)),
        friction,
    )


def _functions(system: Energies, d: int | None) -> Functions:
    """Returns the functions of energies, with friction in forces and accelerations."""
    match system:
        case NaturalSystem():
            functions = natural.functions(system)
        case ExplicitSystem():
            functions = explicit.functions(system)
        case LagrangianSystem():
            functions = lagrangian.functions(system, d)
        case NaturalHamiltonian():
            functions = natural.canonical_functions(system)
        case HamiltonianSystem():
            functions = hamiltonian.functions(system)
        case LoadedSystem(link, load):
            behind = _functions(link, d)
            functions = (
                lambda q, qd, qdd: carrying(load, qd, behind[0](q, qd, qdd)),
                lambda q, qd, tau: behind[1](q, qd, carried(load, qd, tau)),
                *behind[2:],
            )
    force = friction_of(system)
    if force is None:
        return functions
    return (
        lambda q, qd, qdd: functions[0](q, qd, qdd) + force(q, qd),
        lambda q, qd, tau: functions[1](q, qd, tau - force(q, qd)),
        *functions[2:],
    )


@overload
def flow(system: Energies, *, degrees_of_freedom: int | None = None) -> Flow: ...
@overload
def flow(system: PhaseRates, *, degrees_of_freedom: int | None = None) -> Flow | PhaseRates: ...
def flow(system: System, *, degrees_of_freedom: int | None = None) -> Flow | PhaseRates:
    """Returns the functions of a system in (q, p), without applied forces.

    The rates are dq/dt = dH/dp, dp/dt = -dH/dq - dD/dqd (Hamilton). H is the Legendre transform of a Lagrangian.

    Args:
        system: a record of energies, or `PhaseRates`.
        degrees_of_freedom: d, as for `dynamics`.

    Raises:
        InputError: the system is an `InverseForward`, which has no flow, or not a record.

    Example:
        >>> import dln_jax
        >>> cart = dln_jax.flow(dln_jax.LagrangianSystem(lambda q, qd: 1.5 * qd @ qd - 2.0 * q @ q))
        >>> qd, pd = cart.rates([0.5], [6.0])  # p / 3 in m/s, -4 q in N
        >>> print(qd, pd, cart.energy([0.5], [6.0]))
        [2.] [-2.] 6.5
    """
    d = degrees_of_freedom
    if isinstance(system, PhaseRates):
        rates, energy = system
        checked = PhaseRates(lambda q, p: answer(rates, *vectors(d, q=q, p=p)))
        if energy is None:
            return checked
        return Flow(checked.rates, lambda q, p: answer(energy, *vectors(d, q=q, p=p)))
    if not isinstance(system, Energies):
        raise InputError(f"flow got a {type(system).__name__}; expected one of {_names(Energies | PhaseRates)}")
    H = hamiltonian_of(system)

    def hamilton(q, p):
        force, qd = jax.grad(H, argnums=(0, 1))(q, p)
        return qd, driving_force(system, q, qd, jnp.zeros_like(q)) - force

    return Flow(lambda q, p: answer(hamilton, *vectors(d, q=q, p=p)), lambda q, p: answer(H, *vectors(d, q=q, p=p)))


def driving_force(system: Energies, q: Vector, qd: Vector, tau: Vector) -> Vector:
    """Returns the generalised force [d] minus friction: the part that moves the system."""
    if isinstance(system, LoadedSystem):
        return link_force(system, q, qd, tau)
    force = friction_of(system)
    return tau if force is None else tau - force(q, qd)


def hamiltonian_of(system: Energies) -> Hamiltonian:
    """Returns H(q, p) of any energies; of a Lagrangian by the Legendre transform (Newton's method)."""
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


def _names(records: Any) -> str:
    return ", ".join(record.__name__ for record in get_args(records))
