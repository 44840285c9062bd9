"""Functions of any mechanical system, whatever its energy: dynamics under forces, and flow in a phase space."""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from dln_jax.mechanics.arguments import answer, vectors
from dln_jax.types import Dissipation, Potential, Scalar, Vector, VectorLike


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

    Symbols and units are those of `dln_jax.types`. Analytic and learned systems are the same type, so losses, metrics,
    rollouts and controllers do not distinguish them. The functions take arrays, or lists of numbers, and raise a
    one-line InputError for arguments that are not one state of the system.
    """

    inverse_dynamics: Callable[[VectorLike, VectorLike, VectorLike], Array]
    """(q, qd, qdd) -> tau [d]."""
    forward_dynamics: Callable[[VectorLike, VectorLike, VectorLike], Array]
    """(q, qd, tau) -> qdd [d]."""
    energy: Callable[[VectorLike, VectorLike], Array]
    """(q, qd) -> T + V, scalar."""
    mass_matrix: Callable[..., Array]
    """(q, qd=None) -> M [d, d], by default at rest, qd = 0: M of a natural system depends on q alone, that of any other
    energy also on qd."""
    decompose: Callable[[VectorLike, VectorLike, VectorLike], Decomposition]
    """(q, qd, qdd) -> inertial, Coriolis and gravity force, without friction."""
    friction: Callable[[VectorLike, VectorLike], Array]
    """(q, qd) -> the friction force dD/dqd [d]; zero without friction."""


class PlainDynamics(NamedTuple):
    """Functions of a system without energy and mass matrix; otherwise as `Dynamics`."""

    inverse_dynamics: Callable[[VectorLike, VectorLike, VectorLike], Array]
    """(q, qd, qdd) -> tau [d]."""
    forward_dynamics: Callable[[VectorLike, VectorLike, VectorLike], Array]
    """(q, qd, tau) -> qdd [d]."""
    decompose: Callable[[VectorLike, VectorLike, VectorLike], Decomposition]
    """(q, qd, qdd) -> inertial, Coriolis and gravity force; friction counts as Coriolis force."""


Rates = Callable[[VectorLike, VectorLike], tuple[Array, Array]]
"""(q, p) -> (qd, pd), both [d]."""


class Flow(NamedTuple):
    """Functions of an energy in coordinates and momenta, without applied forces; otherwise as `Dynamics`."""

    rates: Rates
    energy: Callable[[VectorLike, VectorLike], Array]
    """(q, p) -> H, scalar."""


class PlainFlow(NamedTuple):
    """Flow of a system without energy."""

    rates: Rates


def make_dynamics(
    inverse_dynamics: Callable[..., Array],
    forward_dynamics: Callable[..., Array],
    decompose: Callable[..., Decomposition],
    energy: Callable[..., Array],
    mass_matrix: Callable[..., Array],
    *,
    dissipation: Dissipation | None = None,
    degrees_of_freedom: int | None = None,
) -> Dynamics:
    """Builds `Dynamics` from functions of vectors [d] of one type; its functions convert or refuse their arguments.

    Without `degrees_of_freedom` the arguments of a call only need to agree with one another; `mass_matrix` is called
    with both q and qd.
    """
    d = degrees_of_freedom

    def mass_matrix_or_at_rest(q, qd=None):
        if qd is None:
            (q,) = vectors(d, q=q)
            return answer(mass_matrix, q, jnp.zeros_like(q))
        return answer(mass_matrix, *vectors(d, q=q, qd=qd))

    def friction(q, qd):
        q, qd = vectors(d, q=q, qd=qd)
        return jnp.zeros_like(qd) if dissipation is None else answer(partial(friction_force, dissipation), q, qd)

    return Dynamics(
        **make_plain_dynamics(inverse_dynamics, forward_dynamics, decompose, degrees_of_freedom=d)._asdict(),
        energy=lambda q, qd: answer(energy, *vectors(d, q=q, qd=qd)),
        mass_matrix=mass_matrix_or_at_rest,
        friction=friction,
    )


def make_plain_dynamics(
    inverse_dynamics: Callable[..., Array],
    forward_dynamics: Callable[..., Array],
    decompose: Callable[..., Decomposition],
    *,
    degrees_of_freedom: int | None = None,
) -> PlainDynamics:
    """Builds dynamics without an energy; arguments as those of `make_dynamics`."""
    d = degrees_of_freedom
    return PlainDynamics(
        lambda q, qd, qdd: answer(inverse_dynamics, *vectors(d, q=q, qd=qd, qdd=qdd)),
        lambda q, qd, tau: answer(forward_dynamics, *vectors(d, q=q, qd=qd, tau=tau)),
        lambda q, qd, qdd: answer(decompose, *vectors(d, q=q, qd=qd, qdd=qdd)),
    )


def plus_potential(kinetic: Scalar, V: Potential | None, q: Vector) -> Scalar:
    """Returns T + V(q), an energy."""
    return kinetic if V is None else kinetic + V(q)


def minus_potential(kinetic: Scalar, V: Potential | None, q: Vector) -> Scalar:
    """Returns T - V(q), a Lagrangian."""
    return kinetic if V is None else kinetic - V(q)


def friction_force(D: Dissipation, q: Vector, qd: Vector) -> Vector:
    """Generalised force dD/dqd [d] that overcomes friction, for a Rayleigh function D(q, qd)."""
    return jax.grad(D, argnums=1)(q, qd)


def decompose_by_differences(
    inverse_dynamics: Callable[[Array, Array, Array], Array], q: Vector, qd: Vector, qdd: Vector
) -> Decomposition:
    """Inertial, Coriolis and gravity force, all [d], as differences of (q, qd, qdd) -> tau between motion and rest.

    Their sum is tau(q, qd, qdd) if M depends on q alone.
    """
    rest = jnp.zeros_like(qd)
    gravity = inverse_dynamics(q, rest, rest)
    return Decomposition(
        inertial=inverse_dynamics(q, rest, qdd) - gravity,
        coriolis=inverse_dynamics(q, qd, rest) - gravity,
        gravity=gravity,
    )
