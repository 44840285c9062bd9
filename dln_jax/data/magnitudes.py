"""Checks that numbers are of a magnitude that losses can square.

Markers of missing values such as 1e308, and unsuitable units, give infinite or zero scales and losses although every
single number is finite.
"""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from dln_jax.types import InputError

MOST_TIMES_TYPICAL = 1e20
"""A number larger than the median by this factor is no measurement: float64 has 16 digits."""


def on_device(name: str, array: np.ndarray, dtype: Any) -> Array:
    """Converts an array of samples to a dtype on the device.

    Raises:
        InputError: the sum of its squares overflows in that dtype.
    """
    _require_squares(name, array, dtype)
    return jnp.asarray(array, dtype)


def spread(name: str, array: Float[np.ndarray, "N k"]) -> Float[np.ndarray, " k"]:
    """Standard deviation of each column, in float64.

    Raises:
        InputError: squares overflow, nonzero numbers are so small that all squares vanish, or some exceed the median by
            `MOST_TIMES_TYPICAL`.
    """
    _require_squares(name, array, np.float64)
    sizes = np.abs(array[array != 0])
    largest = float(sizes.max(initial=0.0))
    if sizes.size and largest > MOST_TIMES_TYPICAL * (typical := float(np.median(sizes))):
        raise InputError(
            f"{name} has numbers of up to {largest:.1e} where half are below {typical:.1e}; remove the samples if they "
            "mark missing values"
        )
    if 0 < largest < np.sqrt(np.finfo(np.float64).tiny):
        raise InputError(f"{name} has numbers of at most {largest:.1e}, whose squares vanish; give it in smaller units")
    return array.std(axis=0)


def _require_squares(name: str, array: np.ndarray, dtype: Any) -> None:
    largest = float(np.abs(array).max(initial=0.0))
    if not largest < np.sqrt(float(np.finfo(dtype).max) / max(array.size, 1)):
        raise InputError(
            f"{name} has numbers of up to {largest:.1e}, whose squares overflow in {np.dtype(dtype).name}; remove the "
            "samples if they mark missing values, else give it in larger units"
        )
