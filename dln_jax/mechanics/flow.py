"""What systems answer in a phase space, without applied forces: the flow of Hamilton's equations."""

from collections.abc import Callable
from typing import NamedTuple

from jax import Array

from dln_jax.types import VectorLike

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
