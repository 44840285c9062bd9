"""Differential networks for functions: units of the fit, predictions with derivatives, their errors and the verdict.

A network with the layer rule h W + b absorbs the scales of its data exactly: it trains in standard units, of zero mean
and unit standard deviation, and is stored in the user's.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from dln_jax.data.arrays import spread
from dln_jax.data.functions import FunctionSamples
from dln_jax.learning.functions import Network
from dln_jax.metrics.errors import mean_square
from dln_jax.metrics.verdict import Verdict, held_out, judge, worst
from dln_jax.nn import differential_mlp
from dln_jax.nn.activations import Activation
from dln_jax.nn.differential_mlp import Layers

QUANTITIES = {"y": "value", "dy": "gradient", "d2y": "hessian"}
"""Names of the quantities in the metrics, by field."""
REMEDY = "train a wider network or longer, or add samples where the function changes quickly"


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
    pairs = zip(weights, biases, strict=True)
    return jax.tree.map(lambda array: jnp.asarray(array, layers[0][0].dtype), tuple(pairs))


def predict(layers: Layers, x: np.ndarray, *, activation: Activation) -> tuple[FunctionSamples, FunctionSamples | None]:
    """Evaluates networks at x [N, n], and returns their means and spreads over the members of the ensemble, float64.

    `layers` have a leading axis of members, even for one. The spread is the sample standard deviation, with the inputs
    in its `x`; `None` for one member.
    """
    members, dtype = layers[0][0].shape[0], layers[0][0].dtype
    network = functools.partial(differential_mlp.value_jacobian_and_hessian, activation=activation)

    def answer(x: jax.Array):
        if members == 1:
            return network(jax.tree.map(lambda leaf: leaf[0], layers), x), None
        return differential_mlp.mean_and_spread(network, layers, x)

    def samples(arrays) -> FunctionSamples:
        return FunctionSamples(*(np.asarray(array, np.float64) for array in (x, *arrays)))

    mean, deviation = jax.jit(jax.vmap(answer))(jnp.asarray(x, dtype))
    return samples(mean), None if deviation is None else samples(deviation)


def errors(predicted: FunctionSamples, truth: FunctionSamples) -> dict[str, float]:
    """Returns the mean over samples of the squared error summed over components (the published metric).

    `value_mse`, and `gradient_mse` and `hessian_mse` if the truth has derivatives; units are squares of the data's.
    """
    off = {
        name: getattr(predicted, key) - getattr(truth, key)
        for key, name in QUANTITIES.items()
        if getattr(truth, key) is not None
    }
    return {f"{name}_mse": mean_square(error.reshape(len(error), -1)) for name, error in off.items()}


def verdict_of(network: Network, predicted: FunctionSamples, truth: FunctionSamples) -> Verdict:
    """Verdict on every component of the value and of the derivatives that were fitted."""
    verdicts = []
    for key in ("y", *["dy"] * (network.loss == "type1"), *["d2y"] * (network.derivative == 2)):
        off = held_out(*(getattr(part, key).reshape(len(part.x), -1) for part in (predicted, truth)))
        names = [f"component {k + 1}" for k in range(len(off.error))]
        verdicts.append(judge(off, names, quantity=QUANTITIES[key]))
    verdict = worst(*verdicts)
    return verdict if verdict.level == "good" else verdict._replace(remedy=REMEDY)
