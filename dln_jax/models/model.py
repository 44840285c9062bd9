"""What every model of the zoo is: a pair of pure functions."""

from collections.abc import Callable
from typing import Any, NamedTuple

from jax import Array

from dln_jax.mechanics.dynamics import Dynamics

Parameters = Any
"""A pytree of arrays."""


class Model(NamedTuple):
    """An energy with parameters, as an (init, apply) pair.

    `apply` closes the parameters over, so that a trained model and a textbook system are the same type and run
    through the same mechanics.
    """

    init: Callable[[Array], Parameters]
    """Random key -> parameters."""
    apply: Callable[[Parameters], Dynamics]
    """Parameters -> dynamics of one state."""
