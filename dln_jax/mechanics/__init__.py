"""Mechanics of any energy, for one state: no batch axis, no network.

`equations.dynamics` and `equations.flow` turn a record of energies into functions; `integrators` step them.
"""

from dln_jax.mechanics import equations, integrators, trees
from dln_jax.mechanics.closed_form import ClosedForm, RecursiveSystem
from dln_jax.mechanics.dynamics import (
    Decomposition,
    Dynamics,
    Flow,
    InverseForward,
    PhaseRates,
    PlainDynamics,
    PlainFlow,
)
from dln_jax.mechanics.equations import hamiltonian_of
from dln_jax.mechanics.friction import joint_dissipation
from dln_jax.mechanics.hamiltonian import HamiltonianSystem, legendre
from dln_jax.mechanics.lagrangian import LagrangianSystem
from dln_jax.mechanics.natural import NaturalHamiltonian, NaturalSystem

__all__ = [
    "ClosedForm",
    "Decomposition",
    "Dynamics",
    "Flow",
    "HamiltonianSystem",
    "InverseForward",
    "LagrangianSystem",
    "NaturalHamiltonian",
    "NaturalSystem",
    "PhaseRates",
    "PlainDynamics",
    "PlainFlow",
    "RecursiveSystem",
    "equations",
    "hamiltonian_of",
    "integrators",
    "joint_dissipation",
    "legendre",
    "trees",
]
