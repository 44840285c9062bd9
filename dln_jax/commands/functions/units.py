"""Scales data for networks: inputs and outputs of zero mean and unit standard deviation.

A network with the layer rule h W + b absorbs the scales exactly: it trains in standard units, stored in the user's.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from dln_jax.data.arrays import spread
from dln_jax.data.functions import FunctionSamples
from dln_jax.nn.differential_mlp import Layers


class Units(NamedTuple):
    """x = x_origin + x_size u and y = y_origin + y_size v, for the standard quantities u [n] and v [m]."""

    x_origin: np.ndarray
    """[n]"""
    x_size: np.ndarray
    """[n]"""
    y_origin: np.ndarray
    """[m]"""
    y_size: np.ndarray
    """[m]"""


def standard_units(data: FunctionSamples) -> Units:
    """Returns the means and standard deviations of the columns; a column that does not vary has size 1.

    Raises:
        InputError: the squares of numbers of x or y are infinite or zero.
    """
    deviations = (spread(name, array) for name, array in (("x", data.x), ("y", data.y)))
    sizes = [np.where(deviation > 0, deviation, 1.0) for deviation in deviations]
    return Units(data.x.mean(axis=0), sizes[0], data.y.mean(axis=0), sizes[1])


def to_units(data: FunctionSamples, units: Units) -> FunctionSamples:
    """Converts samples to other units; derivatives follow the chain rule."""
    ratio = units.x_size[None, :] / units.y_size[:, None]  # of dy/dx, [m, n]
    return FunctionSamples(
        (data.x - units.x_origin) / units.x_size,
        (data.y - units.y_origin) / units.y_size,
        None if data.dy is None else data.dy * ratio,
        None if data.d2y is None else data.d2y * ratio[:, :, None] * units.x_size,
    )


def layers_in_own_units(layers: Layers, units: Units) -> Layers:
    """Converts a network of u and v to the equal network of x and y; leading axes (members of an ensemble) stay."""
    weights, biases = ([np.asarray(layer[part], np.float64) for layer in layers] for part in range(2))
    weights[0] = weights[0] / units.x_size[:, None]
    biases[0] = biases[0] - units.x_origin @ weights[0]
    weights[-1] = weights[-1] * units.y_size
    biases[-1] = biases[-1] * units.y_size + units.y_origin
    dtype = layers[0][0].dtype
    return tuple((jnp.asarray(w, dtype), jnp.asarray(b, dtype)) for w, b in zip(weights, biases, strict=True))
