"""Functions of any mechanical system, whatever its energy: dynamics under forces, and flow in a phase space."""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from dln_jax.mechanics.arguments import vectors
from dln_jax.types import Dissipation, Hamiltonian, Potential, Scalar, Vector, VectorLike


class Decomposition(NamedTuple):
    """Parts of the generalised force, `tau = inertial + coriolis + gravity` for a natural system, all [d]."""

    inertial: Array
    """tau(q, 0, qdd) - tau(q, 0, 0)."""
    coriolis: Array
    """tau(q, qd, 0) - tau(q, 0, 0)."""
    gravity: Array
    """tau(q, 0, 0)."""


class Dynamics(NamedTuple):
    """Functions of an energy in coordinates and velocities, for one state; use `vmap` for samples.

    `dln_jax.types` defines symbols and units. Analytic and learned systems have the same type, so losses, metrics,
    rollouts and controllers need not distinguish them. The functions take arrays or lists of numbers, and raise a
    one-line InputError for arguments that are not one state of the system.
    """

    inverse_dynamics: Callable[[VectorLike, VectorLike, VectorLike], Array]
    """(q, qd, qdd) -> tau [d]."""
    forward_dynamics: Callable[[VectorLike, VectorLike, VectorLike], Array]
    """(q, qd, tau) -> qdd [d]."""
    energy: Callable[[VectorLike, VectorLike], Array]
    """(q, qd) -> T + V, scalar. Data do not determine the constant of a learned energy or, without torques, its
    scale."""
    mass_matrix: Callable[..., Array]
    """(q, qd=None) -> M [d, d], by default at qd = 0; M depends on qd only if the system is not natural."""
    decompose: Callable[[VectorLike, VectorLike, VectorLike], Decomposition]
    """(q, qd, qdd) -> inertial, Coriolis and gravity forces, without friction. Data may determine only the sum of
    gravity and friction (`learning.dynamics`)."""
    friction: Callable[[VectorLike, VectorLike], Array]
    """(q, qd) -> friction force dD/dqd [d]; zero without friction."""


Rates = Callable[[VectorLike, VectorLike], tuple[Array, Array]]
"""(q, p) -> (qd, pd), both [d]."""


class Flow(NamedTuple):
    """Functions of an energy in coordinates and momenta, without applied forces; otherwise like `Dynamics`."""

    rates: Rates
    energy: Callable[[VectorLike, VectorLike], Array]
    """(q, p) -> H, scalar."""


class InverseForward(NamedTuple):
    """A system without energy: two functions of one state that need not be inverses of each other.

    It is the record of networks without physics. `dynamics` checks the arguments and returns the same record; there is
    no energy, no mass matrix and no flow. All vectors are [d], in SI units.

    Example:
        >>> import dln_jax
        >>> system = dln_jax.InverseForward(lambda q, qd, qdd: 2 * qdd + 3 * qd, lambda q, qd, tau: (tau - 3 * qd) / 2)
        >>> print(dln_jax.dynamics(system).inverse_dynamics([0.5], [1.0], [2.0]))
        [7.]
    """

    inverse_dynamics: Callable[..., Array]
    """(q, qd, qdd) -> tau [d]."""
    forward_dynamics: Callable[..., Array]
    """(q, qd, tau) -> qdd [d]."""

    def decompose(self, q: VectorLike, qd: VectorLike, qdd: VectorLike) -> Decomposition:
        """Returns inertial, Coriolis and gravity forces; friction counts as Coriolis force."""
        return decompose_by_differences(self.inverse_dynamics, *vectors(q=q, qd=qd, qdd=qdd))


class PhaseRates(NamedTuple):
    """Rates of a state in a phase space.

    It is the record of vector fields that need not come from an energy. `flow` checks the arguments and returns the
    rates, with the energy if there is one. It defines no forces, so `dynamics` raises `InputError`.

    Example:
        >>> import dln_jax
        >>> damped = dln_jax.PhaseRates(lambda q, p: (p, -4 * q - 0.1 * p))
        >>> qd, pd = dln_jax.flow(damped).rates([1.0], [2.0])
        >>> print(qd, pd.round(2))
        [2.] [-4.2]
    """

    rates: Callable[..., tuple[Array, Array]]
    """(q, p) -> (qd, pd), both [d]."""
    hamiltonian: Hamiltonian | None = None
    """(q, p) -> energy of a part of the field; `None` for a field without energy."""


Functions = tuple[
    Callable[..., Array], Callable[..., Array], Callable[..., Array], Callable[..., Array], Callable[..., Decomposition]
]
"""The first five functions of `Dynamics`, without friction and without checks; `mass_matrix` takes both q and qd."""


def plus_potential(kinetic: Scalar, V: Potential | None, q: Vector) -> Scalar:
    """Returns T + V(q), an energy."""
    return kinetic if V is None else kinetic + V(q)


def minus_potential(kinetic: Scalar, V: Potential | None, q: Vector) -> Scalar:
    """Returns T - V(q), a Lagrangian."""
    return kinetic if V is None else kinetic - V(q)


def friction_force(D: Dissipation, q: Vector, qd: Vector) -> Vector:
    """Returns the generalised force dD/dqd [d] that overcomes friction, for a Rayleigh function D(q, qd)."""
    return jax.grad(D, argnums=1)(q, qd)


def friction_of(system: Any) -> Callable[[Array, Array], Array] | None:
    """Returns (q, qd) -> friction force [d] of a record, in closed form if it has one; `None` without friction."""
    force = getattr(system, "friction", None)
    if force is not None or system.dissipation is None:
        return force
    return partial(friction_force, system.dissipation)


def decompose_by_differences(
    inverse_dynamics: Callable[[Array, Array, Array], Array], q: Vector, qd: Vector, qdd: Vector
) -> Decomposition:
    """Splits (q, qd, qdd) -> tau into inertial, Coriolis and gravity forces, all [d], by differences from rest.

    Their sum is tau(q, qd, qdd) if M depends on q alone.
    """
    rest = jnp.zeros_like(qd)
    gravity = inverse_dynamics(q, rest, rest)
    return Decomposition(
        inertial=inverse_dynamics(q, rest, qdd) - gravity,
        coriolis=inverse_dynamics(q, qd, rest) - gravity,
        gravity=gravity,
    )
