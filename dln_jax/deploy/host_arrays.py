"""Arguments of functions that copy from the host's memory, where an assignment would broadcast silently."""

from typing import Any

import numpy as np

from dln_jax.mechanics.arguments import require_shape
from dln_jax.types import InputError


def as_shaped(name: str, argument: Any, shape: tuple[int, ...]) -> Any:
    """The argument where it is an array of this shape, else such an array of the numbers that it holds.

    Raises:
        InputError: another shape, or nothing that is an array of numbers.
    """
    try:
        if argument.shape == shape and argument.dtype.kind in "fiu":
            return argument
    except AttributeError:
        pass
    try:
        array = np.asarray(argument)
    except (ValueError, TypeError):
        raise InputError(f"{name} makes no array; expected real numbers of shape {shape}") from None
    if array.dtype.kind not in "fiu":
        raise InputError(f"{name} has type {array.dtype}; expected real numbers of shape {shape}")
    require_shape(name, array.shape, shape)
    return array
