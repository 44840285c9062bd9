"""What every mechanical system answers, whatever energy it comes from."""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from dln_jax.mechanics.arguments import vectors
from dln_jax.types import InputError, Vector, VectorLike


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
    rollouts, controllers) cannot tell them apart. `make_dynamics` makes one, whose functions take arrays, or lists of
    numbers, and refuse in one line (InputError) what is no state of one system.
    """

    inverse_dynamics: Callable[[VectorLike, VectorLike, VectorLike], Array]
    """(q, qd, qdd) -> tau [d]."""
    forward_dynamics: Callable[[VectorLike, VectorLike, VectorLike], Array]
    """(q, qd, tau) -> qdd [d]."""
    energy: Callable[[VectorLike, VectorLike], Array]
    """(q, qd) -> T + V, scalar; raises InputError for a model that comes from no energy (`has_energy` says so)."""
    mass_matrix: Callable[..., Array]
    """(q, qd=None) -> M [d, d], by default at rest, qd = 0: of a natural system M depends on q alone, of any other
    energy on qd too. Raises as `energy` does."""
    decompose: Callable[[VectorLike, VectorLike, VectorLike], Decomposition]
    """(q, qd, qdd) -> inertial, Coriolis and gravity force; friction is no part of it where a model knows it apart."""
    hamiltonian: Callable[[VectorLike, VectorLike], Array] | None = None
    """(q, p) -> H, scalar; `None` for a model that is not Hamiltonian."""
    friction: Callable[[VectorLike, VectorLike], Array] | None = None
    """(q, qd) -> the force dD/dqd [d] that friction takes; `None` without friction, or where it is not known apart."""

    @property
    def has_energy(self) -> bool:
        """Whether there are an energy and a mass matrix."""
        return self.energy is not no_energy


def no_energy(*state: VectorLike, **named: VectorLike) -> Array:
    """Energy and mass matrix of a model that comes from no energy: raises InputError."""
    raise InputError("the model comes from no energy: it has no mass matrix either; take another model to ask for them")


def make_dynamics(
    *,
    inverse_dynamics: Callable[..., Array],
    forward_dynamics: Callable[..., Array],
    decompose: Callable[..., Decomposition],
    energy: Callable[..., Array] | None = None,
    mass_matrix: Callable[..., Array] | None = None,
    hamiltonian: Callable[..., Array] | None = None,
    friction: Callable[..., Array] | None = None,
    degrees_of_freedom: int | None = None,
) -> Dynamics:
    """Dynamics whose functions convert their arguments or refuse them, from functions of vectors [d] of one type.

    Args:
        inverse_dynamics: as in `Dynamics`, and so are the others.
        forward_dynamics: (q, qd, tau) -> qdd.
        decompose: (q, qd, qdd) -> parts.
        energy: (q, qd) -> scalar; `None` for a model that comes from no energy.
        mass_matrix: (q, qd) -> M, called with qd = 0 where the caller gives none; `None` as above.
        hamiltonian: (q, p) -> H.
        friction: (q, qd) -> force.
        degrees_of_freedom: d; without it the arguments of a call need to agree with one another only.
    """
    d = degrees_of_freedom

    def mass_matrix_or_at_rest(q, qd=None):
        assert mass_matrix is not None
        if qd is None:
            (q,) = vectors(d, q=q)
            return mass_matrix(q, jnp.zeros_like(q))
        return mass_matrix(*vectors(d, q=q, qd=qd))

    return Dynamics(
        inverse_dynamics=lambda q, qd, qdd: inverse_dynamics(*vectors(d, q=q, qd=qd, qdd=qdd)),
        forward_dynamics=lambda q, qd, tau: forward_dynamics(*vectors(d, q=q, qd=qd, tau=tau)),
        energy=no_energy if energy is None else lambda q, qd: energy(*vectors(d, q=q, qd=qd)),
        mass_matrix=no_energy if mass_matrix is None else mass_matrix_or_at_rest,
        decompose=lambda q, qd, qdd: decompose(*vectors(d, q=q, qd=qd, qdd=qdd)),
        hamiltonian=hamiltonian and (lambda q, p: hamiltonian(*vectors(d, q=q, p=p))),
        friction=friction and (lambda q, qd: friction(*vectors(d, q=q, qd=qd))),
    )


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
