"""What every model of the zoo is: parameters, and the energies that they give."""

from collections.abc import Callable
from typing import Any, NamedTuple

from jax import Array

Parameters = Any
"""A pytree of arrays."""


class Model(NamedTuple):
    """Energies with parameters, as a pair of pure functions.

    `energies` closes the parameters over, so that a trained model and a textbook system are the same type and run
    through the same mechanics: `mechanics.equations.dynamics(model.energies(parameters))`.
    """

    init: Callable[[Array], Parameters]
    """Random key -> parameters."""
    energies: Callable[[Parameters], Any]
    """Parameters -> a record of energies, one of `mechanics.equations.System`, as functions of one state."""
