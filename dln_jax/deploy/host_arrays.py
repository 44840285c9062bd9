"""Arguments of functions that copy from the host's memory, where an assignment would broadcast silently."""

from typing import Any

import numpy as np

from dln_jax.types import InputError


def as_shaped(name: str, argument: Any, shape: tuple[int, ...]) -> Any:
    """The argument where it is an array of this shape, else such an array of the numbers that it holds.

    Raises:
        InputError: another shape, or nothing that is an array of numbers.
    """
    try:
        if argument.shape == shape:
            return argument
    except AttributeError:
        pass
    try:
        array = np.asarray(argument)
        fits = array.shape == shape and array.dtype.kind in "biuf"
    except (ValueError, TypeError):
        raise InputError(f"{name} is no array of numbers; expected shape {shape}, one state at a time") from None
    if not fits:
        raise InputError(f"{name} is {array.dtype} {array.shape}; expected shape {shape}, one state at a time")
    return array
