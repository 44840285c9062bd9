"""Systems that come from no energy: networks for what a motion takes, for how it goes on, or for rates of a state."""

import functools
from collections.abc import Callable
from typing import NamedTuple

from jax import Array

from dln_jax.mechanics.dynamics import PlainDynamics, decompose_by_differences, make_plain_dynamics
from dln_jax.types import Hamiltonian


class InverseForward(NamedTuple):
    """Two functions of one state that need not invert each other."""

    inverse_dynamics: Callable[[Array, Array, Array], Array]
    """(q, qd, qdd) -> tau [d]."""
    forward_dynamics: Callable[[Array, Array, Array], Array]
    """(q, qd, tau) -> qdd [d]."""


class PhaseRates(NamedTuple):
    """Rates of a state of a phase space."""

    rates: Callable[[Array, Array], tuple[Array, Array]]
    """(q, p) -> (qd, pd), each [d]."""
    hamiltonian: Hamiltonian | None = None
    """(q, p) -> the energy of a part of the field; `None` for a field without one."""


def dynamics(system: InverseForward, *, degrees_of_freedom: int | None = None) -> PlainDynamics:
    """All functions of the system at once; with `degrees_of_freedom` they refuse states of another size.

    The force decomposition is that of differences of the inverse function, so friction counts as Coriolis force.
    """
    decompose = functools.partial(decompose_by_differences, system.inverse_dynamics)
    return make_plain_dynamics(*system, decompose, degrees_of_freedom=degrees_of_freedom)
