"""Systems without energy: networks for inverse dynamics, forward dynamics, or rates of a phase space."""

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
    """(q, p) -> (qd, pd), both [d]."""
    hamiltonian: Hamiltonian | None = None
    """(q, p) -> energy of a part of the field; `None` for a field without one."""


def dynamics(system: InverseForward, *, degrees_of_freedom: int | None = None) -> PlainDynamics:
    """Returns all functions of the system; with `degrees_of_freedom` they refuse states of another size.

    The force decomposition takes differences of the inverse function, so friction counts as Coriolis force.
    """
    decompose = functools.partial(decompose_by_differences, system.inverse_dynamics)
    return make_plain_dynamics(*system, decompose, degrees_of_freedom=degrees_of_freedom)
