"""What systems answer in a phase space, without applied forces: the flow of Hamilton's equations."""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from dln_jax.mechanics import hamiltonian
from dln_jax.mechanics.arguments import vectors
from dln_jax.types import Dissipation, Hamiltonian, Vector, VectorLike

Rates = Callable[[VectorLike, VectorLike], tuple[Array, Array]]
"""(q, p) -> (qd, pd), each [d]."""


class Flow(NamedTuple):
    """What an energy answers in coordinates and momenta; functions of one state, as those of `Dynamics`."""

    rates: Rates
    """(q, p) -> (qd, pd), each [d]."""
    energy: Callable[[VectorLike, VectorLike], Array]
    """(q, p) -> H, scalar."""


class PlainFlow(NamedTuple):
    """What moves without an energy."""

    rates: Rates
    """(q, p) -> (qd, pd), each [d]."""


def make_flow(H: Hamiltonian, *, dissipation: Dissipation | None = None, degrees_of_freedom: int | None = None) -> Flow:
    """Hamilton's equations of an energy, with the friction of a Rayleigh function where there is one.

    With `degrees_of_freedom` the functions refuse states of another size.
    """

    def rates(q: Vector, p: Vector) -> tuple[Vector, Vector]:
        return hamiltonian.time_derivative(H, q, p, jnp.zeros_like(q), dissipation=dissipation)

    d = degrees_of_freedom
    return Flow(make_plain_flow(rates, degrees_of_freedom=d).rates, lambda q, p: H(*vectors(d, q=q, p=p)))


def make_plain_flow(rates: Callable[..., tuple[Array, Array]], *, degrees_of_freedom: int | None = None) -> PlainFlow:
    """A flow whose function converts its arguments or refuses them, from one of vectors [d] of one type."""
    return PlainFlow(lambda q, p: rates(*vectors(degrees_of_freedom, q=q, p=p)))
