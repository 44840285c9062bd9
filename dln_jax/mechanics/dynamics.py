"""What every mechanical system answers, whatever energy it comes from."""

from collections.abc import Callable
from typing import NamedTuple

from jax import Array


class Decomposition(NamedTuple):
    """Parts of the generalised force of a Lagrangian, `tau = inertial + coriolis + gravity`, each [d]."""

    inertial: Array
    """tau(q, 0, qdd) - tau(q, 0, 0)."""
    coriolis: Array
    """tau(q, qd, 0) - tau(q, 0, 0)."""
    gravity: Array
    """tau(q, 0, 0)."""


class Dynamics(NamedTuple):
    """Functions of one state; `vmap` them over samples. Symbols and units as in `dln_jax.types`.

    Analytic systems and learned ones are the same type, so whatever consumes dynamics (losses, metrics,
    rollouts, controllers) cannot tell them apart.
    """

    inverse_dynamics: Callable[[Array, Array, Array], Array]
    """(q, qd, qdd) -> tau [d]."""
    forward_dynamics: Callable[[Array, Array, Array], Array]
    """(q, qd, tau) -> qdd [d]."""
    energy: Callable[[Array, Array], Array]
    """(q, qd) -> T + V, scalar."""
    mass_matrix: Callable[..., Array]
    """(q, qd) -> M [d, d]; natural systems take (q) as well, since their M depends on q alone."""
    decompose: Callable[[Array, Array, Array], Decomposition]
    """(q, qd, qdd) -> inertial, Coriolis and gravity force; friction is no part of it."""
