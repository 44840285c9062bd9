"""Predictions of differential networks for a function and its derivatives, their errors, and the verdict on them."""

import functools

import jax
import jax.numpy as jnp
import numpy as np

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

    mean, spread = jax.jit(jax.vmap(answer))(jnp.asarray(x, dtype))
    return samples(mean), None if spread is None else samples(spread)


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
