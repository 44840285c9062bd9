"""What every mechanical system answers, whatever energy it comes from."""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from dln_jax.types import Vector


class Decomposition(NamedTuple):
    """Parts of the generalised force, `tau = inertial + coriolis + gravity` for a natural system, each [d]."""

    inertial: Array
    """tau(q, 0, qdd) - tau(q, 0, 0)."""
    coriolis: Array
    """tau(q, qd, 0) - tau(q, 0, 0)."""
    gravity: Array
    """tau(q, 0, 0)."""


class Dynamics(NamedTuple):
    """Functions of one state; `vmap` them over samples. Symbols and units as in `dln_jax.types`.

    Analytic systems and learned ones are the same type, so whatever consumes dynamics (losses, metrics,
    rollouts, controllers) cannot tell them apart. What a model cannot answer is `None`.
    """

    inverse_dynamics: Callable[[Array, Array, Array], Array]
    """(q, qd, qdd) -> tau [d]."""
    forward_dynamics: Callable[[Array, Array, Array], Array]
    """(q, qd, tau) -> qdd [d]."""
    energy: Callable[[Array, Array], Array] | None
    """(q, qd) -> T + V, scalar; `None` for a model that comes from no energy."""
    mass_matrix: Callable[..., Array] | None
    """(q, qd) -> M [d, d]; natural systems take (q) as well, since their M depends on q alone. `None` as above."""
    decompose: Callable[[Array, Array, Array], Decomposition]
    """(q, qd, qdd) -> inertial, Coriolis and gravity force; friction is no part of it where a model knows it apart."""
    hamiltonian: Callable[[Array, Array], Array] | None = None
    """(q, p) -> H, scalar; `None` for a model that is not Hamiltonian."""
    friction: Callable[[Array, Array], Array] | None = None
    """(q, qd) -> the force dD/dqd [d] that friction takes; `None` without friction, or where it is not known apart."""


def decompose_by_differences(
    inverse_dynamics: Callable[[Array, Array, Array], Array], q: Vector, qd: Vector, qdd: Vector
) -> Decomposition:
    """Inertial, Coriolis and gravity force, each [d], as differences of (q, qd, qdd) -> tau between moving and resting.

    Their sum is tau(q, qd, qdd) when M depends on q alone.
    """
    rest = jnp.zeros_like(qd)
    gravity = inverse_dynamics(q, rest, rest)
    return Decomposition(
        inertial=inverse_dynamics(q, rest, qdd) - gravity,
        coriolis=inverse_dynamics(q, qd, rest) - gravity,
        gravity=gravity,
    )
