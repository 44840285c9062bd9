"""What every mechanical system answers, whatever energy it comes from: under forces, and in a phase space."""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from dln_jax.mechanics.arguments import answer, vectors
from dln_jax.types import Dissipation, Potential, Scalar, Vector, VectorLike


class Decomposition(NamedTuple):
    """Parts of the generalised force, `tau = inertial + coriolis + gravity` for a natural system, each [d]."""

    inertial: Array
    """tau(q, 0, qdd) - tau(q, 0, 0)."""
    coriolis: Array
    """tau(q, qd, 0) - tau(q, 0, 0)."""
    gravity: Array
    """tau(q, 0, 0)."""


class Dynamics(NamedTuple):
    """What an energy answers in coordinates and velocities; functions of one state, which `vmap` takes over samples.

    Symbols and units as in `dln_jax.types`. Analytic systems and learned ones are the same type, so whatever consumes
    dynamics (losses, metrics, rollouts, controllers) cannot tell them apart. The functions take arrays, or lists of
    numbers, and refuse in one line (InputError) what is no state of one system.
    """

    inverse_dynamics: Callable[[VectorLike, VectorLike, VectorLike], Array]
    """(q, qd, qdd) -> tau [d]."""
    forward_dynamics: Callable[[VectorLike, VectorLike, VectorLike], Array]
    """(q, qd, tau) -> qdd [d]."""
    energy: Callable[[VectorLike, VectorLike], Array]
    """(q, qd) -> T + V, scalar."""
    mass_matrix: Callable[..., Array]
    """(q, qd=None) -> M [d, d], by default at rest, qd = 0: of a natural system M depends on q alone, of any other
    energy on qd too."""
    decompose: Callable[[VectorLike, VectorLike, VectorLike], Decomposition]
    """(q, qd, qdd) -> inertial, Coriolis and gravity force, without friction."""
    friction: Callable[[VectorLike, VectorLike], Array]
    """(q, qd) -> the force dD/dqd [d] that friction takes; zero without friction."""


class PlainDynamics(NamedTuple):
    """What answers without an energy, and has no mass matrix either; otherwise as `Dynamics`."""

    inverse_dynamics: Callable[[VectorLike, VectorLike, VectorLike], Array]
    """(q, qd, qdd) -> tau [d]."""
    forward_dynamics: Callable[[VectorLike, VectorLike, VectorLike], Array]
    """(q, qd, tau) -> qdd [d]."""
    decompose: Callable[[VectorLike, VectorLike, VectorLike], Decomposition]
    """(q, qd, qdd) -> inertial, Coriolis and gravity force; friction counts as Coriolis force."""


Rates = Callable[[VectorLike, VectorLike], tuple[Array, Array]]
"""(q, p) -> (qd, pd), each [d]."""


class Flow(NamedTuple):
    """What an energy answers in coordinates and momenta, without applied forces; otherwise as `Dynamics`."""

    rates: Rates
    energy: Callable[[VectorLike, VectorLike], Array]
    """(q, p) -> H, scalar."""


class PlainFlow(NamedTuple):
    """What moves without an energy."""

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
    """`Dynamics` whose functions convert their arguments or refuse them, from functions of vectors [d] of one type.

    Without `degrees_of_freedom` the arguments of a call need to agree with one another only; `mass_matrix` is called
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
    """Dynamics without an energy; arguments as those of `make_dynamics`."""
    d = degrees_of_freedom
    return PlainDynamics(
        lambda q, qd, qdd: answer(inverse_dynamics, *vectors(d, q=q, qd=qd, qdd=qdd)),
        lambda q, qd, tau: answer(forward_dynamics, *vectors(d, q=q, qd=qd, tau=tau)),
        lambda q, qd, qdd: answer(decompose, *vectors(d, q=q, qd=qd, qdd=qdd)),
    )


def plus_potential(kinetic: Scalar, V: Potential | None, q: Vector) -> Scalar:
    """T + V(q), of an energy."""
    return kinetic if V is None else kinetic + V(q)


def minus_potential(kinetic: Scalar, V: Potential | None, q: Vector) -> Scalar:
    """T - V(q), of a Lagrangian."""
    return kinetic if V is None else kinetic - V(q)


def friction_force(D: Dissipation, q: Vector, qd: Vector) -> Vector:
    """Generalised force dD/dqd [d] that overcomes friction, for a Rayleigh function D(q, qd)."""
    return jax.grad(D, argnums=1)(q, qd)


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
