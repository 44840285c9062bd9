"""Predictions of differential networks for a function and its derivatives, and their errors."""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from dln_jax.data.functions import FunctionSamples
from dln_jax.metrics.errors import mean_square
from dln_jax.nn import differential_mlp, ensembles
from dln_jax.nn.activations import Activation
from dln_jax.nn.differential_mlp import Layers

QUANTITIES = {"y": "value", "dy": "gradient", "d2y": "hessian"}
"""Names of the quantities in the metrics, by field."""


class Prediction(NamedTuple):
    """Predictions of an ensemble at N inputs, with the inputs in `x` of both fields; arrays are float64."""

    mean: FunctionSamples
    """Value, Jacobian and Hessian of a single network, or their means over the members."""
    spread: FunctionSamples | None
    """Sample standard deviation over the members; `None` for a single network."""


def predictions(layers: Layers, x: np.ndarray, *, activation: Activation) -> Prediction:
    """Evaluates networks at x [N, n]; `layers` have a leading axis of ensemble members, even for one."""
    members, dtype = layers[0][0].shape[0], layers[0][0].dtype
    network = functools.partial(differential_mlp.value_jacobian_and_hessian, activation=activation)

    def answer(x: jax.Array):
        if members == 1:
            return network(jax.tree.map(lambda leaf: leaf[0], layers), x), None
        return ensembles.mean_and_spread(network, layers, x)

    mean, spread = jax.jit(jax.vmap(answer))(jnp.asarray(x, dtype))
    return Prediction(_samples(x, mean), None if spread is None else _samples(x, spread))


def errors(predicted: FunctionSamples, truth: FunctionSamples) -> dict[str, float]:
    """Returns the mean over samples of the squared error summed over components (the published metric).

    `value_mse`, and `gradient_mse` and `hessian_mse` if the truth has derivatives; units are squares of the data's.
    """
    result = {}
    for key, name in QUANTITIES.items():
        if getattr(truth, key) is not None:
            error = getattr(predicted, key) - getattr(truth, key)
            result[f"{name}_mse"] = mean_square(error.reshape(len(error), -1))
    return result


def typical_spread(spread: FunctionSamples, where: np.ndarray) -> float:
    """Returns the root mean square of the value's spread over the inputs selected by the mask `where` [N]."""
    return float(np.sqrt(np.mean(spread.y[where] ** 2)))


def _samples(x: np.ndarray, arrays) -> FunctionSamples:
    return FunctionSamples(np.asarray(x, np.float64), *(np.asarray(array, np.float64) for array in arrays))
